"""The `check` command: validates the file and prints the plan of each line."""

import json
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated

import typer
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.cli.config.line_plans import modem_plan, modem_warnings, served_plan
from gateway.cli.progress import progress
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, err, out
from gateway.config import Config, expanded_text, load, state_folder
from gateway.config.loading import written
from gateway.config.messages import dotted
from gateway.engine.forecast import LineForecast, dark_for, why_not_learned
from gateway.northbound.northbound import check as zenoh_warnings
from gateway.parts.doors.plan import door_plans, door_warnings
from gateway.parts.history.settings import HistorySection
from gateway.parts.history.store.place import trouble
from gateway.parts.transfers.forecast import TransferForecast, forecasts, transfer_forecasts
from gateway.parts.web import exposure
from gateway.planning.planner import describe
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.capabilities import ChangesBits
from gateway.tags.tag import CounterRule
from gateway.transport.port import ListenAddress, SerialPath

# The system counts adapters in the order in which it finds them.
_COUNTED = re.compile(r"/dev/tty(USB|ACM)[0-9]+\Z")


def check(
    config: ConfigPath,
    blocks: Annotated[
        bool | None,
        typer.Option("--blocks/--no-blocks", help="Every request (default: if at most 100)"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="End with 1 if a line is overloaded.")
    ] = False,
    expand: Annotated[
        bool, typer.Option("--expand", help="Print the file with its templates expanded instead.")
    ] = False,
    port: Annotated[
        bool,
        typer.Option("--port", help="Open serial ports and say what drivers take; send nothing."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Validate the file and print the plan of each line. Sends nothing."""
    if expand:
        load(config)
        print(expanded_text(config), end="")
        return
    with progress(err) as report:
        loaded = load(config, report)
        lines = forecasts(loaded, report)
    coded = [
        {"code": code, "text": text} for code, texts in _warnings(loaded, lines) for text in texts
    ]
    warnings = [one["text"] for one in coded]
    notes, errors = [*_notes(loaded)], [*_unwritable(loaded)]
    if port:
        from gateway.cli.config.port_check import port_sentences  # it loads serialx

        good, bad = port_sentences(loaded.lines)
        notes, errors = [*good, *notes], [*bad, *errors]
    if as_json:
        found = {"notes": notes, "warnings": warnings, "errors": errors, "coded": coded}
        print(json.dumps({"file": str(config), "lines": [*map(_document, lines)], **found}))
    else:
        few = sum(len(line.blocks) for line in lines) <= 100
        out.print(plan(lines, every_block=few if blocks is None else blocks))
        for part in _special(loaded, lines):
            out.print(part)
        for kind, sentences in (("note", notes), ("warning", warnings), ("error", errors)):
            for sentence in sentences:
                err.print(f"{kind}: {sentence}")
    if errors:
        sys.exit(FAILED)
    if not as_json:
        print(f"{config}: good, {size(loaded)}")
    if strict and any(line.overloaded for line in lines):
        sys.exit(FAILED)


def _warnings(config: Config, lines: Sequence[LineForecast]) -> Iterator[tuple[str, Iterable[str]]]:
    """Yields the warnings by code: docs/codes.md."""
    by_name = {line.name: line for line in config.lines}
    yield "overloaded", (line.advice() for line in lines if line.overloaded)
    yield "zenoh", zenoh_warnings(config)
    yield "page-exposed", exposure.check(config)
    yield "port-exposed", _open_to_all(config)
    yield "port-counted", _may_change_places(config)
    yield "door", door_warnings(config, lines)
    yield "disk-fills", _too_large(config)
    yield "calls", (text for one in lines for text in modem_warnings(by_name[one.name], one))


def _document(line: LineForecast) -> dict[str, object]:
    """Returns the plan of a line for programs. Times in seconds."""
    blocks = [
        {
            "device": row.device.name,
            "request": describe(row.block),
            "tags": [tag.key for tag in row.block.tags],
            "every": row.block.every,
            "takes": row.seconds,
            "worst_age": row.worst_age,
        }
        for row in line.blocks
    ]
    numbers = ("load", "load_proven", "requests", "characters", "cycle", "worst_write")
    return {
        "line": line.name,
        "baudrate": line.wire.baudrate,
        **{name: getattr(line, name) for name in numbers},
        "blocks": blocks,
    }


def _special(config: Config, lines: Sequence[LineForecast]) -> Iterator[RenderableType]:
    """Yields what is special: lines without polls, modems, transfers, doors."""
    yield from _without_polls(config)
    planned = {line.name: line for line in lines}
    for line in config.lines:
        if line.modem is not None or line.close_after:
            yield Text(modem_plan(line, planned.get(line.name)))
    if config.transfers:
        yield _transfers(transfer_forecasts(config, lines))
    yield from map(Text, door_plans(config, lines))


def _without_polls(config: Config) -> Iterator[RenderableType]:
    """Yields the served lines, and which tags of the listen-only lines can be learned."""
    yield from (served_plan(line) for line in config.lines if line.serve)
    for line in config.lines:
        if not line.listen_only:
            continue
        tags = [(device.driver, tag) for device in line.devices for tag in device.wire_tags]
        reasons = {tag.key: why for driver, tag in tags if (why := why_not_learned(driver, tag))}
        yield (
            f"line {line.name} only listens: {len(tags) - len(reasons)} of "
            f"{_counted(len(tags), 'tag')} can be learned, when another master reads them"
        )
        yield from (f"  {key} cannot: {why}" for key, why in reasons.items())


def _may_change_places(config: Config) -> list[str]:
    """Returns a warning if adapters have names in the order in which the system found them: a
    line could then show the values of another one."""
    ports = {line.name: line.port for line in config.lines}
    found = {name: port.path for name, port in ports.items() if isinstance(port, SerialPath)}
    counted = {name: path for name, path in found.items() if _COUNTED.match(path)}
    if len(counted) < 2:
        return []
    (one, first), (other, second), *_ = counted.items()
    text = f"lines {one} and {other}: {first} and {second} may change places after a restart, and "
    text += (
        "each line then asks the devices of the other; write their names in /dev/serial/by-id/, "
    )
    return [f"{text}or in /dev/serial/by-path/ for adapters without a serial number"]


def _open_to_all(config: Config) -> list[str]:
    """Returns a warning for each port that anybody can connect to as a device server."""
    ports = {line.name: line.port for line in config.lines}
    return [
        f"line {name}: any computer that reaches {port.host}:{port.port} can answer for its "
        "devices: write `device_server: {allow: [10.1.0.0/16]}` with your networks"
        for name, port in ports.items()
        if isinstance(port, ListenAddress) and not port.server.networks
    ]


def _notes(config: Config) -> Iterator[str]:
    asked = [(one, tag) for one in config.devices if one.served is None for tag in one.tags]
    tags = [tag for _, tag in asked]
    for device, tag in asked:
        if tag.write is not None and tag.part is not None:
            part, driver = "one bit" if tag.address.bit is not None else "one byte", device.driver
            may_mask = isinstance(driver, ChangesBits) and driver.changes_bits(tag.span)
            unless = ", unless the device has function 22" if may_mask else ""
            yield (
                f"writing {tag.key} ({tag.text}) reads the word, changes {part} and writes "
                f"the word back; changes by the PLC in between are lost{unless}"
            )
    for tag in tags:
        if tag.origin.kept is None and (limit := tag.exact_below) is not None:
            yield (
                f"{tag.key} ({tag.text}): a JSON number has 53 bits. Beyond {limit:.4g}"
                " either way two values of the device can look equal, and a write can be one"
                " step off"
            )
    totals = [tag.key for tag in tags if isinstance(tag.origin.kept, CounterRule)]
    if totals and config.state_file is None:
        yield (
            f"{', '.join(totals[:5])}: a total begins again at each start of the gateway: "
            "write `state: state.json` below `gateway:`"
        )
    for sheet in config.sheets:
        yield from (f"{sheet.file.name}: {note}" for note in sheet.notes)


def _too_large(config: Config) -> Iterator[str]:
    """Yields a warning for a history that its disk cannot hold."""
    history = config.part(HistorySection)
    if history is not None and (folder := history.path.resolve().parent).is_dir():
        whole = shutil.disk_usage(folder).total
        if history.max_size > whole:
            yield (
                f"history.max_size: {history.max_size / 1e9:.0f} GB, but the disk of "
                f"{history.path} has {whole / 1e9:.0f} GB: the history fills it before it ends"
            )


def _unwritable(config: Config) -> Iterator[str]:
    """Yields a sentence for each file that the gateway could not write."""
    below = "set" if state_folder() else "not set"
    for setting, file, _, _ in written(config):
        if (why := trouble(file)) is not None:
            yield (
                f"{dotted(setting)}: {file} cannot be written: {why}. Check as the user of the "
                f"service, with its $STATE_DIRECTORY ({below} here)"
            )


def size(config: Config) -> str:
    """Returns the size of a configuration: `22 tags on 3 lines`."""
    tags = sum(len(device.tags) for device in config.devices)
    return f"{_counted(tags, 'tag')} on {_counted(len(config.lines), 'line')}"


def plan(lines: Sequence[LineForecast], *, every_block: bool) -> RenderableType:
    """Renders the plan of all lines."""
    parts: list[RenderableType] = []
    for line in lines:
        parts.append(_line(line))
        if every_block and (line.blocks or line.unsolicited):
            parts.append(_blocks(line))
            parts.extend(map(Text, _dark(line)))
        parts.append(Text())
    return Group(*parts)


def _line(line: LineForecast) -> Text:
    writes = (
        f"\n  worst write latency {seconds(line.worst_write)}, "
        f"{seconds(line.worst_write_silent)} when a station has just gone offline"
    )
    returned = f"\n  a silent station that returns is seen within {seconds(line.seen_within)}"
    if line.seen_at_worst > line.seen_within:
        returned += f", {seconds(line.seen_at_worst)} while polls take all of the wire"
    if not line.blocks:
        text = f"line {line.name}: no requests {_speed(line.wire)}"
        return Text(text + writes if line.worst_write else text)
    return Text(
        f"line {line.name}: {_counted(len(line.blocks), 'request')}, {line.requests:.2f} a second, "
        f"{line.characters:.0f} characters a second {_speed(line.wire)}\n"
        f"  load {line.load:.1%} of the wire; one round of all requests takes {seconds(line.cycle)}"
        + writes
        + returned
        + _proven(line)
    )


def _proven(line: LineForecast) -> str:
    """Returns the load while extra replies arrive."""
    if line.load_proven == line.load:  # all replies carry a number
        return ""
    return f"\n  load {line.load_proven:.1%} after an extra reply: each read is proven then"


def _dark(line: LineForecast) -> Iterator[str]:
    """Yields what one silent address costs each device."""
    for device in dict.fromkeys(row.device for row in line.blocks):
        if (time := dark_for(device, line.load)) is not None:
            most = f"{seconds(time)} at most"
            yield f"  {device.name}: one address without replies darkens others for {most}"


def _blocks(line: LineForecast) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("  device", "request", "tags", "every", "characters", "takes", "worst age"):
        table.add_column(column)
    for row in line.blocks:
        block = row.block
        table.add_row(
            f"  {row.device.name}",
            describe(block),
            str(len(block.tags)),
            seconds(block.every),
            f"{block.cost.request} + {block.cost.reply}",
            seconds(row.seconds),
            seconds(row.worst_age),
        )
    for device, tags in line.unsolicited:
        table.add_row(f"  {device.name}", "unsolicited", str(tags))
    return table


def seconds(time: float) -> str:
    """Formats a duration: `12.3 ms`, `1.43 s`."""
    return f"{time * 1000:.1f} ms" if time < 1 else f"{time:.2f} s"


def _transfers(rows: Sequence[TransferForecast]) -> RenderableType:
    """Renders the transfers: their share of the line that they write on is in its load."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("  row", "from", "to", "when", "takes", "line", "load", "worst age"):
        table.add_column(column)
    for row in rows:
        source, target = row.rule.text
        table.add_row(
            f"  {row.rule.number}",
            Text(source),
            Text(target),
            row.rule.when,
            seconds(row.writes.seconds),
            Text(row.line),
            f"{row.load:.1%}",
            "" if row.worst_age is None else seconds(row.worst_age),
        )
    return Group(Text("transfers, if each value changes with each read:"), table, Text())


def _speed(wire: WireTiming) -> str:
    return "over the network" if wire.baudrate == NETWORK_BAUD else f"at {wire.baudrate} baud"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
