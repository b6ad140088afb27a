"""The part of `check` about served lines: the addresses that a master may read and write."""

from collections.abc import Iterator

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.config import LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.protocols.driver import Address, Span
from gateway.stations.served.registers import Served, ServedTag


def served_plan(line: LineConfig) -> RenderableType:
    """Renders the stations of one served line."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("  station", "address", "type", "the master", "tag", "the value comes from"):
        table.add_column(column)
    for device in line.devices:
        served = device.served
        for row in served.rows if served is not None else ():
            table.add_row(f"  {device.name} {device.driver.station}", *_cells(row))
        for text in _untagged(device):
            table.add_row(f"  {device.name} {device.driver.station}", text, "", "reads, writes")
    stations = ", ".join(str(device.driver.station) for device in line.devices)
    protocol = line.devices[0].driver.protocol if line.devices else ""
    head = f"line {line.name}: a master asks station {stations} by {protocol}"
    return Group(Text(head), table, Text())


def _cells(row: ServedTag) -> Iterator[str]:
    tag = row.tag
    yield tag.text
    yield str(tag.layout.type)
    yield "reads, writes" if row.accepted else "reads"
    yield "" if row.source is not None else tag.key
    if row.accepted:
        yield "the master"
    elif row.source is not None:
        yield row.source + (", the last good one if it is bad" if row.hold_last else "")
    else:
        yield "clients on Zenoh" + (", kept over restarts" if row.retain else "")


def _untagged(device: DeviceSettings) -> Iterator[str]:
    """Yields the parts of `accept` without a tag: memory that only the master uses."""
    served = device.served or Served(rows=())
    tagged = {
        (row.tag.span.area, row.tag.span.start + i)
        for row in served.rows
        for i in range(row.tag.span.size)
    }
    for area, start, size in served.accept:
        first: int | None = None
        for number in range(start, start + size + 1):
            free = number < start + size and (area, number) not in tagged
            if free and first is None:
                first = number
            elif not free and first is not None:
                yield _range(device, Span(area, first, number - first))
                first = None


def _range(device: DeviceSettings, span: Span) -> str:
    first, last = (
        device.driver.spell(Address(span.area, number))
        for number in (span.start, span.start + span.size - 1)
    )
    return first if span.size == 1 else f"{first}..{last}"
