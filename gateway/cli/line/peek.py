"""The `peek` command: addresses of a device in every type, to find out what they mean."""

import asyncio
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from gateway.cli.client import Client, NoGateway, connected
from gateway.cli.line import direct
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.line.peek_table import Cell, change_text, table_of
from gateway.cli.progress import loaded
from gateway.cli.terminal import FAILED, AsJson, end, err, out
from gateway.config import Config, built, load
from gateway.config.settings import parsers
from gateway.config.yaml.scalars import scalar
from gateway.engine.device.device import Device
from gateway.errors import ConfigError, GatewayError
from gateway.protocols.driver import Address, AnyDriver, Unit
from gateway.protocols.ranges import addresses
from gateway.protocols.registry import PROTOCOLS
from gateway.tags import Quality, Reason, Sample, Tag, good
from gateway.tags.unit_tag import unit_tag

MOST = 1000  # addresses
MARKED = 5.0  # seconds for which a change is marked

PortOption = Annotated[
    str | None, typer.Option(help="/dev/ttyUSB0, tcp://host:port, rfc2217://...")
]
ProtocolOption = Annotated[str | None, typer.Option(help="as the file names it after `protocol:`")]
SettingOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="a setting of the device, as in the file"),
]


def peek(
    arguments: Annotated[
        list[str],
        typer.Argument(
            metavar="[CONFIG DEVICE] RANGE", help="D100..D119; with a file: of one of its devices"
        ),
    ],
    port: PortOption = None,
    protocol: ProtocolOption = None,
    station: Annotated[int | None, typer.Option(help="its station number")] = None,
    baud: Annotated[int | None, typer.Option(help="9600 (default: by protocol)")] = None,
    serial_format: Annotated[
        str | None, typer.Option("--format", help="7E1 (default: by protocol)")
    ] = None,
    setting: SettingOption = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Read again and again; mark changes. Ctrl-C ends it.")
    ] = False,
    every: Annotated[str, typer.Option(help="the interval with --watch")] = "500ms",
    as_json: AsJson = False,
) -> None:
    """Read a range of addresses and print it in every type and word order. Only reads.

    With a file it asks the running gateway, if there is one. Otherwise it opens the port itself.
    """
    options = {"port": port, "protocol": protocol, "station": station, "baudrate": baud}
    options["format"] = serial_format
    config, text = _target(arguments, options, setting or [])
    view = view_of(config, text, parsers.interval(every))
    set_up(LogFormat.TEXT, LogLevel.ERROR)
    with _gateway(Path(arguments[0]) if len(arguments) == 3 else None) as client:
        ask = None if client is None else partial(asked, client, view, text)
        if watch:
            with suppress(KeyboardInterrupt):
                asyncio.run(_follow(view, ask))
            return
        samples = asyncio.run(direct.read(view.config, view.tags)) if ask is None else ask()
    view.samples(samples)
    some = any(sample.quality is Quality.GOOD for sample in samples)
    if as_json:
        for tag in view.tags:
            cell = view.cell(tag)
            print(json.dumps({"address": cell.address, "raw": cell.raw, "note": cell.note}))
    elif some:
        out.print(view.table(out.width))
    for failure in dict.fromkeys(sample.detail for sample in samples if sample.detail):
        err.print(failure)
    if not some:
        end(f"nothing of {text} could be read: {samples[0].reason}", FAILED)


@contextmanager
def _gateway(config: Path | None) -> Iterator[Client | None]:
    """Yields a client of the running gateway; None where there is none, or no file."""
    with ExitStack() as stack:
        try:
            found = None
            if config is not None:
                found = stack.enter_context(connected(loaded(config), err.print))
        except NoGateway:
            found = None
        yield found


def asked(client: Client, view: "View", text: str) -> list[Sample]:
    """Returns what the gateway reads now. Raises `GatewayError`."""
    device = view.tags[0].device
    answer = client.requests.peek(device, text)
    units = answer.get("units")
    if not isinstance(units, list) or len(units) != len(view.tags):
        raise GatewayError(f"{device}: {answer.get('reason') or answer.get('error') or answer}")
    now = time.time_ns()
    return [good(tag, int(unit), now) for tag, unit in zip(view.tags, units, strict=True)]


def _target(
    arguments: list[str], options: Mapping[str, object], settings: Sequence[str]
) -> tuple[Config, str]:
    """Returns the configuration of one device, and the range."""
    if len(arguments) == 3:
        given = [name for name, value in options.items() if value is not None]
        if given or settings:
            raise ConfigError("with a file, its settings are used: leave out --port and the others")
        loaded = load(Path(arguments[0]))
        return only(loaded, arguments[1]), arguments[2]
    if len(arguments) != 1:
        raise ConfigError("write a RANGE such as D100..D119, or CONFIG DEVICE RANGE")
    return one_device(options, settings), arguments[0]


def one_device(options: Mapping[str, object], settings: Sequence[str]) -> Config:
    """Returns a configuration of one device from the options of a command."""
    for name in ("port", "protocol"):
        if options[name] is None:
            raise ConfigError(f"--{name} is missing; or name a file and a device before the range")
    line = {name: options[name] for name in ("port", "baudrate", "format")}
    device = {name: options[name] for name in ("protocol", "station")}
    known = PROTOCOLS.get(str(options["protocol"]))
    if known is not None and "format" in {one.name for one in fields(known.settings)}:
        device["format"] = options["format"]  # a station that is set so: `one_format`
    device |= given_settings(settings, "addressing=k120s")
    given = {name: value for name, value in device.items() if value is not None}
    line = {name: value for name, value in line.items() if value is not None}
    return built({"lines": {"peek": {**line, "devices": {"peek": given}}}})


def given_settings(texts: Sequence[str], example: str) -> dict[str, object]:
    """Returns the settings of the option `--set`. Raises `ConfigError`."""
    found: dict[str, object] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: write NAME=VALUE, such as {example}")
        found[name] = scalar(value)
    return found


def only(config: Config, name: str) -> Config:
    others = {device.name for device in config.devices} - {name}
    left = config.without(others)
    if not left.devices:
        raise ConfigError(f"there is no device {name}: the file has {', '.join(sorted(others))}")
    return left


@dataclass(slots=True)
class View:
    """The newest value at each address. A `SampleSink`."""

    config: Config
    tags: list[Tag]
    unit: Unit
    driver: AnyDriver
    names: Mapping[int, str]  # of tags of the file, by address
    newest: dict[Tag, Sample] = field(default_factory=dict)
    changed: dict[Tag, float] = field(default_factory=dict)  # when
    news: list[str] = field(default_factory=list)  # changes, a line each

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.reason is Reason.STARTING:
                continue
            before = self.newest.get(sample.tag)
            self.newest[sample.tag] = sample
            if before is None or _raw(before) != _raw(sample):
                self.news.append(change_text(self.cell(sample.tag), _raw(before), self.unit))
                if before is not None:
                    self.changed[sample.tag] = time.monotonic()

    def online(self, device: Device, online: bool) -> None:
        """The samples say all that counts here."""

    def cell(self, tag: Tag) -> Cell:
        sample = self.newest.get(tag)
        note = self.names.get(tag.span.start, "")
        if sample is not None and sample.quality is not Quality.GOOD:
            note = f"bad: {sample.reason}"
        changed = time.monotonic() - self.changed.get(tag, -MARKED) < MARKED
        return Cell(tag.text, _raw(sample), changed, note)

    def table(self, width: int) -> Table:
        cells = [self.cell(tag) for tag in self.tags]
        return table_of(cells, self.unit, self.driver.traits.string_order, width)

    def changes(self) -> list[str]:
        """Returns the changes since the last call."""
        news, self.news = self.news, []
        return news


def _raw(sample: Sample | None) -> int | None:
    if sample is None or sample.quality is not Quality.GOOD:
        return None
    return int(sample.value) if isinstance(sample.value, int) else 0


def view_of(config: Config, text: str, every: float = 1.0) -> View:
    """Returns the view of a range of the only device. Raises `ConfigError`."""
    (line,) = config.lines
    (device,) = line.devices
    driver = device.driver
    area, numbers = addresses(driver, text, MOST)
    unit = driver.areas[area].unit
    tags = [
        unit_tag(device.name, driver, Address(area, number), f"{area}{number}", every)
        for number in numbers
    ]
    names = names_at(device.tags, area)
    peeked = replace(device, tags=tuple(tags), enabled=True)
    lines = (replace(line, devices=(peeked,)),)
    return View(replace(config, lines=lines), tags, unit, driver, names)


def names_at(tags: Sequence[Tag], area: str) -> dict[int, str]:
    """Returns the names of the tags of an area by address."""
    return {
        number: tag.name
        for tag in reversed(tags)
        if tag.span.area == area
        for number in range(tag.span.start, tag.span.start + tag.span.size)
    }


async def _poll(view: View, ask: Callable[[], list[Sample]]) -> None:
    while True:
        view.samples(await asyncio.to_thread(ask))
        await asyncio.sleep(view.tags[0].every)


async def _follow(view: View, ask: Callable[[], list[Sample]] | None) -> None:
    """Reads until Ctrl-C, and shows the newest values."""
    following = direct.follow(view.config, view) if ask is None else _poll(view, ask)
    reading = asyncio.create_task(following)
    try:
        if out.is_terminal:
            with Live(
                console=out, refresh_per_second=5, get_renderable=lambda: view.table(out.width)
            ):
                await reading
        while not reading.done():
            for line in view.changes():
                print(line, flush=True)
            await asyncio.wait([reading], timeout=0.1)
        await reading
    finally:
        reading.cancel()
