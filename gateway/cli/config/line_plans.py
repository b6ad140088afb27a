"""The parts of `check` about served lines and lines with a modem or rounds of connections."""

from collections.abc import Iterator

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.config import LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.forecast import LineForecast
from gateway.protocols.driver import Address, Span
from gateway.stations.served.registers import Served, ServedTag
from gateway.transport import ModemSettings

LATE = 1.5  # seconds by which a telephone line with error correction delays a reply
HOUR = 3600.0


def modem_plan(line: LineConfig, forecast: LineForecast | None) -> str:
    """Describes the calls or connections of a line. Without `forecast` a modem answers calls."""
    modem = line.modem
    if modem is None:
        more = f"each takes {line.connect_delay:g} s longer than above (connect_delay)"
        return f"line {line.name} connects for each round and each write: {more}"
    if forecast is None:
        idle = f"{modem.idle:g} s without a byte"
        return f"line {line.name} answers calls, and hangs up after {idle}"
    call, tries = call_seconds(modem, forecast), modem.tries
    worst = tries * (modem.dial_timeout + hang_up_seconds(modem)) + (tries - 1) * modem.retry_pause
    every = shortest(forecast)
    calls = f", at most {HOUR / every:.3g} calls an hour" if every else ""
    return (
        f"line {line.name} dials {modem.number}: a call takes up to {call:.0f} s "
        f"({modem.dial_timeout:g} s to the carrier, {forecast.cycle:.1f} s for all requests, "
        f"{modem.idle:g} s idle, {hang_up_seconds(modem):.1f} s to hang up){calls}\n"
        f"  the times above count in a call; a write waits up to {modem.dial_timeout:g} s for it\n"
        f"  without a carrier the values turn bad after {worst:.0f} s ({tries} tries)"
    )


def modem_warnings(line: LineConfig, forecast: LineForecast) -> Iterator[str]:
    """Yields a sentence for each setting that does not suit a telephone line."""
    modem, every = line.modem, shortest(forecast)
    if modem is None:
        return
    if every and every <= 2 * modem.idle:
        yield (
            f"line {line.name} never hangs up: its shortest interval is {every:g} s, "
            f"and a call ends after {modem.idle:g} s without an exchange (`idle`)"
        )
    elif every and every < (call := call_seconds(modem, forecast)):
        yield (
            f"line {line.name} dials all the time: its shortest interval is {every:g} s, and a "
            f"call takes up to {call:.0f} s"
        )
    for device in line.devices:
        timeout = device.timing.reply_timeout
        if device.enabled and timeout < LATE:
            yield (
                f"{device.name} has {timeout:g} s to reply, and a telephone line delays replies "
                "by up to a second: write reply_timeout: 3s"
            )


def shortest(forecast: LineForecast) -> float:
    """Returns the shortest interval of the line; 0: nothing is polled."""
    return min((one.block.every for one in forecast.blocks), default=0.0)


def call_seconds(modem: ModemSettings, forecast: LineForecast) -> float:
    """Returns the longest duration of a call that reads everything."""
    return modem.dial_timeout + forecast.cycle + modem.idle + hang_up_seconds(modem)


def hang_up_seconds(modem: ModemSettings) -> float:
    """Returns the usual time of a hang-up by +++, without the signal DTR."""
    return 2 * modem.guard


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
