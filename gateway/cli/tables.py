"""Tables for people: samples, plans, what is typed next."""

import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.tags.timestamps import rfc3339
from gateway.cli.client import Shown
from gateway.cli.scan import Report, spoken
from gateway.config import Config
from gateway.engine.forecast import LineForecast
from gateway.planning.planner import describe
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.tags import Quality, Sample, Tag, WriteRule
from gateway.values import Kind


def shown(sample: Sample) -> Shown:
    """A sample of our own as it would have arrived from Zenoh."""
    document: dict[str, object] = {
        "value": sample.value,
        "quality": sample.quality.value,
        "time": rfc3339(sample.time),
    }
    if sample.reason is not None:
        document["reason"] = sample.reason.value
    return Shown(sample.tag.key, document)


def is_good(sample: Shown) -> bool:
    return sample.document.get("quality") == Quality.GOOD


def samples(rows: Iterable[Shown], tags: dict[str, Tag]) -> Table:
    """A table of current values, one row a tag."""
    table = Table(box=None, pad_edge=False)
    for column in ("tag", "value", "unit", "quality", "time"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for row in rows:
        document = row.document
        good = is_good(row)
        quality = "good" if good else f"bad: {document.get('reason')}"
        tag = tags.get(row.tag)
        table.add_row(
            Text(row.tag),
            Text("-" if document.get("value") is None else _value(document["value"])),
            Text(tag.unit if tag else ""),
            Text(quality, style="" if good else "red"),
            Text(str(document.get("time", ""))),
        )
    return table


def outcome(tag: str, answer: dict[str, object]) -> str:
    """How a write ended, in one line."""
    if "error" in answer:
        code = f" {answer['code']}" if answer.get("code") else ""
        return f"{tag}: {answer['error']}{code}: {answer.get('reason')}"
    took = f"{float(str(answer['took'])) * 1000:.0f} ms"
    how = "acknowledged by the PLC"
    if answer.get("verified"):
        how = "acknowledged and read back"
    elif answer.get("acknowledged") is False:
        how = "broadcast, nobody acknowledges it"
    return f"{tag} = {_value(answer['value'])}: {how}, {took}"


def live(screen: Console, news: Iterable[Shown], tags: dict[str, Tag]) -> None:
    """A table of the newest, until the news end."""
    rows: dict[str, Shown] = {}

    def table() -> RenderableType:
        return fitting(screen, [rows[tag] for tag in sorted(rows)], tags)

    with Live(console=screen, refresh_per_second=5, get_renderable=table):
        for row in news:
            rows[row.tag] = row


def fitting(screen: Console, rows: Sequence[Shown], tags: dict[str, Tag]) -> RenderableType:
    """The table, or of one that is higher than the screen its head and how many rows are left."""
    room = len(rows) if len(rows) < screen.height else max(screen.height - 2, 0)
    while room and _height(screen, samples(rows[:room], tags)) + (room < len(rows)) > screen.height:
        room -= 1  # a long text takes several lines
    table = samples(rows[:room], tags)
    if room == len(rows):
        return table
    note = f"{len(rows) - room} more: name the tags you want to see, or enlarge the window"
    return Group(table, Text(note, overflow="ellipsis", no_wrap=True))


def _height(screen: Console, table: Table) -> int:
    return len(screen.render_lines(table))


def typed() -> str:
    """How this program was started, so that what it prints can be typed again."""
    program = Path(sys.argv[0])
    if program.name == "__main__.py":
        return f"{sys.executable} -m {program.parent.name}"
    return program.name if shutil.which(program.name) else str(program)


def plan(lines: Sequence[LineForecast], *, every_block: bool) -> RenderableType:
    """The plan of all lines, as `check` prints it."""
    parts: list[RenderableType] = []
    for line in lines:
        parts.append(_line(line))
        if every_block:
            parts.append(_blocks(line))
        parts.append(Text())
    return Group(*parts)


def _line(line: LineForecast) -> Text:
    writes = (
        f"\n  worst write latency {seconds(line.worst_write)}, "
        f"{seconds(line.worst_write_silent)} while a station has just gone silent"
    )
    if not line.blocks:
        text = f"line {line.name}: nothing is asked {_speed(line.wire)}"
        return Text(text + writes if line.worst_write else text)
    return Text(
        f"line {line.name}: {_counted(len(line.blocks), 'request')}, {line.requests:.2f} a second, "
        f"{line.characters:.0f} characters a second {_speed(line.wire)}\n"
        f"  load {line.load:.1%} of the wire; one round of everything takes {seconds(line.cycle)}"
        + writes
    )


def stations(report: Report, port: str) -> str:
    """What was found, as it is written in the file."""
    serial = report.found[0].serial
    lines = ["lines:", "  found:", f"    port: {port}"]
    if serial is not None:
        lines += [f"    baudrate: {serial.baudrate}", f"    format: {serial.format}"]
    lines.append("    devices:")
    for found in report.found:
        driver = found.driver
        said = {"protocol": driver.protocol, "station": driver.station, **found.settings}
        settings = ", ".join(f"{name}: {_value(value)}" for name, value in said.items())
        refusal = f"  # it said no: {found.refusal}" if found.refusal else ""
        lines.append(f"      station-{driver.station}: {{{settings}, tags: {{}}}}{refusal}")
    return "\n".join(lines)


def noises(report: Report) -> Iterator[str]:
    """Where something was heard that was no answer: one sentence each."""
    for serial, what in report.noises.items():
        yield f"at {spoken(serial)} something was heard that is no answer: {what}"


def size(config: Config) -> str:
    """`22 tags on 3 lines`."""
    tags = sum(len(device.tags) for device in config.devices)
    return f"{_counted(tags, 'tag')} on {_counted(len(config.lines), 'line')}"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _speed(wire: WireTiming) -> str:
    return "over the network" if wire.baudrate == NETWORK_BAUD else f"at {wire.baudrate} baud"


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
    for device, tags in line.unasked:
        table.add_row(f"  {device.name}", "comes unasked", str(tags))
    return table


def seconds(time: float) -> str:
    """`12.3 ms`, `1.43 s`."""
    return f"{time * 1000:.1f} ms" if time < 1 else f"{time:.2f} s"


def next_steps(config: Config, path: Path, command: str) -> str:
    """What a newcomer types in a second terminal; `command` is how this one was started."""
    file = shlex.quote(str(path))
    tags = [tag for device in config.devices for tag in device.tags]
    lines = [
        f"Gateway {config.name}: {size(config)}. In a second terminal:",
        f"  {command} watch {file}",
    ]
    if tags:
        lines.append(f"  {command} read {file} {tags[0].key}")
    for tag in tags:
        if tag.write is not None:
            lines.append(f"  {command} write {file} {tag.key} {_example(tag)}")
            break
    lines.append("Ctrl-C ends it.")
    return "\n".join(lines)


def _example(tag: Tag) -> str:
    """A value that the tag takes."""
    kind, rule = tag.layout.type, tag.write or WriteRule()
    if kind.kind is Kind.STRING:
        return "AB"[: kind.length]
    if not kind.is_number:
        return "true"
    value = 1 if rule.min is None else rule.min + 1
    return f"{value if rule.max is None else min(value, rule.max):g}"


def _value(value: object) -> str:
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else str(value)
