"""Replays a wire log: the values that a listen-only line would have learned from these bytes.

So a reply that may belong to another request counts for nothing. `of_units` and `courses` find the
addresses that the requests of a log read, and their values by time.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from gateway.config import LineConfig
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.effects import Effect, Samples
from gateway.engine.engine import Engine
from gateway.errors import ConfigError
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue
from gateway.protocols.driver import Address, Span
from gateway.protocols.listening import Asked, Listenable
from gateway.simulator.recorded import Change, RecordedValues, Unit, units_asked
from gateway.tags import Reason, Sample
from gateway.tags.unit_tag import unit_tag
from gateway.values import Value

SILENT_BEFORE = 1.0  # seconds; the log begins between two frames
UNTIMED = 0.05  # seconds from one piece to the next
_ALWAYS = 1e9  # seconds; no value of a recording is too old


class Learned(NamedTuple):
    """Samples of one reply, or values that turned bad. `at`: by the clock of the log."""

    at: float
    samples: Sequence[Sample]


class Difference(NamedTuple):
    """A value of the log, and what the replay made of the same bytes."""

    logged: LoggedValue
    learned: Value | None


@dataclass(slots=True)
class Checked:
    """The count of the values of a log, compared with those of its replay."""

    equal: int = 0
    different: int = 0
    missing: int = 0  # the replay learned nothing: a reply that may belong to another request


@dataclass(slots=True)
class _Part:
    """The devices of a line with one kind of frames, and their engine."""

    engine: Engine
    driver: Listenable

    def asks(self, data: bytes, character: float) -> bool:
        """Returns True for one whole request."""
        heard = self.driver.traffic_reader(character).feed(data, math.inf)
        return len(heard) == 1 and isinstance(heard[0], Asked)


class Replay:
    """Feeds a wire log to the drivers and the engine of a line, by the clock of the log.

    On a line with several protocols each request, and what follows it, goes to the devices whose
    protocol it is.
    """

    def __init__(self, line: LineConfig) -> None:
        """Raises `ConfigError` for a protocol whose traffic cannot be learned."""
        self._character = line.wire.character
        framings: dict[object, list[Device]] = {}
        drivers: dict[object, Listenable] = {}
        for one in line.devices:
            driver = one.driver
            if not isinstance(driver, Listenable):
                raise ConfigError(f"{one.name}: {driver.protocol} cannot be replayed")
            drivers[driver.framing] = driver
            if one.enabled:
                device = Device(replace(one, listen_only=True), line.wire)
                framings.setdefault(driver.framing, []).append(device)
        self._parts = [
            _Part(Engine(line.name, devices, line.wire), drivers[framing])
            for framing, devices in framings.items()
        ]
        self._last = -math.inf
        self._values: dict[str, Sample] = {}  # learned since the last value of the log, by tag
        self.checked = Checked()

    def run(self, log: Iterable[LoggedPiece | LoggedValue]) -> Iterator[Learned | Difference]:
        """Yields what is learned, and each value of the log that differs from it."""
        parts = self._parts
        speaks = parts[0] if len(parts) == 1 else None
        for entry in log:
            if isinstance(entry, LoggedValue):
                yield from self._compare(entry)
                continue
            at = self._last if entry.at is None else max(entry.at, self._last)
            self._last = at = at if math.isfinite(at) else 0.0
            for part in parts:
                yield from self._until(part.engine, at)
            if len(parts) > 1 and entry.way == ">":
                asking = (part for part in parts if part.asks(entry.data, self._character))
                speaks = next(asking, None)
            if speaks is not None:
                yield from self._learned(at, speaks.engine.received(entry.data, at, _ns(at)))

    def _until(self, engine: Engine, at: float) -> Iterator[Learned]:
        if not engine.is_open:
            yield from self._learned(at, engine.opened(at - SILENT_BEFORE))
        while (due := engine.deadline) <= at:
            yield from self._learned(due, engine.expire(due, _ns(due)))

    def _learned(self, at: float, effects: Iterable[Effect]) -> Iterator[Learned]:
        for effect in effects:
            if isinstance(effect, Samples):
                self._values |= {sample.tag.key: sample for sample in effect.samples}
                yield Learned(at, effect.samples)

    def _compare(self, logged: LoggedValue) -> Iterator[Difference]:
        sample = self._values.pop(logged.tag, None)
        if sample is None or (sample.value is None and logged.value is not None):
            self.checked.missing += 1
        elif sample.value == logged.value:
            self.checked.equal += 1
        else:
            self.checked.different += 1
            yield Difference(logged, sample.value)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def timed(log: Iterable[LoggedPiece | LoggedValue]) -> Iterator[LoggedPiece]:
    """Yields the bytes of a log. Those without a time follow each other in 50 ms."""
    last = 0.0
    for entry in log:
        if isinstance(entry, LoggedPiece):
            last = last + UNTIMED if entry.at is None else entry.at
            yield entry._replace(at=last)


def stations_asked(driver: Listenable, log: Sequence[LoggedPiece], character: float) -> list[int]:
    """Returns the numbers of the stations that requests of the protocol name."""
    found, last, reader = set[int](), -math.inf, driver.traffic_reader(character)
    for piece in log:
        at = _at(piece)
        silence, last = (at - last if math.isfinite(last) else SILENT_BEFORE), at
        found |= {one.station for one in reader.feed(piece.data, silence) if isinstance(one, Asked)}
    return sorted(found)


def of_units(line: LineConfig, log: Sequence[LoggedPiece]) -> LineConfig:
    """Returns the line with a tag for each unit that a request names, instead of its own tags."""
    requests = [(_at(piece), piece.data) for piece in log if piece.way == ">"]
    requests = requests or [(_at(piece), piece.data) for piece in log]  # of a listen-only line
    devices = (_of_units(device, requests) for device in line.devices)
    return replace(line, devices=tuple(one for one in devices if one.tags))


def courses(line: LineConfig, log: Iterable[LoggedPiece]) -> Mapping[str, RecordedValues]:
    """Returns the values of each device by time. `line`: of units.

    Raises `ConfigError` for a protocol whose traffic cannot be learned.
    """
    found = {device.name: RecordedValues() for device in line.devices}
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
