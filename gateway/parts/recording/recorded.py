"""The units in a recording: the addresses that its requests read, and the course of their values.

The values are those that a listen-only line would learn, so a reply that may belong to another
request counts for nothing.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from gateway.config import LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.parts.recording.replay import SILENT_BEFORE, Learned, Replay
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue
from gateway.protocols.driver import Address, Span
from gateway.protocols.listening import Asked, Listenable
from gateway.simulator.recorded import Change, Course, Unit, units_asked
from gateway.tags import Reason
from gateway.tags.unit_tag import unit_tag

UNTIMED = 0.05  # seconds from one piece to the next
_ALWAYS = 1e9  # seconds; no value of a recording is too old


def timed(log: Iterable[LoggedPiece | LoggedValue]) -> Iterator[LoggedPiece]:
    """Yields the bytes of a log. Those without a time follow each other in 50 ms."""
    last = 0.0
    for entry in log:
        if isinstance(entry, LoggedPiece):
            last = last + UNTIMED if entry.at is None else entry.at
            yield entry._replace(at=last)


def stations_asked(driver: Listenable, log: Sequence[LoggedPiece], character: float) -> list[int]:
    """Returns the numbers of the stations that requests of the protocol name."""
    found, last, ear = set[int](), -math.inf, driver.ear(character)
    for piece in log:
        at = _at(piece)
        silence, last = (at - last if math.isfinite(last) else SILENT_BEFORE), at
        found |= {one.station for one in ear.feed(piece.data, silence) if isinstance(one, Asked)}
    return sorted(found)


def of_units(line: LineConfig, log: Sequence[LoggedPiece]) -> LineConfig:
    """Returns the line with a tag for each unit that a request names, instead of its own tags."""
    requests = [(_at(piece), piece.data) for piece in log if piece.way == ">"]
    requests = requests or [(_at(piece), piece.data) for piece in log]  # of a listen-only line
    devices = (_of_units(device, requests) for device in line.devices)
    return replace(line, devices=tuple(one for one in devices if one.tags))


def courses(line: LineConfig, log: Iterable[LoggedPiece]) -> Mapping[str, Course]:
    """Returns the values of each device by time. `line`: of units.

    Raises `ConfigError` for a protocol whose traffic cannot be learned.
    """
    found = {device.name: Course() for device in line.devices}
    newest: dict[tuple[str, Unit], int] = {}
    doubtful: dict[tuple[str, Unit], Change] = {}  # until the next reply: it may turn them bad

    def settle() -> None:
        for (device, unit), change in doubtful.items():
            if newest.get((device, unit)) != change.value:
                newest[device, unit] = change.value
                found[device].changes.append(change)
        doubtful.clear()

    for event in Replay(line).run(log):
        if not isinstance(event, Learned):
            continue
        samples = [one for one in event.samples if one.reason is not Reason.STARTING]
        bad = [one for one in samples if one.value is None]
        for sample in bad:
            doubtful.pop((sample.tag.device, _unit(sample.tag.span)), None)
        if len(bad) < len(samples):
            settle()
        for sample in samples:
            if isinstance(sample.value, int):  # a bit or a word
                unit = _unit(sample.tag.span)
                change = Change(event.at, unit, int(sample.value))
                doubtful[sample.tag.device, unit] = change
    settle()
    return found


def _of_units(device: DeviceSettings, requests: Sequence[tuple[float, bytes]]) -> DeviceSettings:
    driver, tags = device.driver, []
    for area, number in units_asked(driver, requests):
        if area in driver.areas and driver.areas[area].readable:
            address = Address(area, number)
            tags.append(unit_tag(device.name, driver, address, driver.spell(address), _ALWAYS))
    return replace(device, enabled=True, served=None, tags=tuple(tags))


def _unit(span: Span) -> Unit:
    return span.area, span.start


def _at(piece: LoggedPiece) -> float:
    return piece.at or 0.0
