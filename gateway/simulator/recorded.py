"""Simulated PLCs with the values of a recording: what it does not hold they do not have."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.protocols.driver import Address, AnyDriver
from gateway.protocols.listening import Asked, Listenable, TrafficReader
from gateway.stations.registry import station_of
from gateway.stations.station import Memory

Unit = tuple[str, int]  # area and number


class Change(NamedTuple):
    """A unit has another value from `at` on."""

    at: float
    unit: Unit
    value: int


@dataclass(slots=True)
class RecordedValues:
    """The values of the units of one device by time. Before its first value a unit has that one."""

    changes: list[Change] = field(default_factory=list)

    @property
    def first(self) -> dict[Unit, int]:
        return {change.unit: change.value for change in reversed(self.changes)}


@dataclass(slots=True)
class Answered:
    """The count of requests, and of those that the recording does not hold, by their text."""

    requests: int = 0
    unknown: Counter[str] = field(default_factory=Counter)


class RecordedStation:
    """A PLC that has the recorded units only, each with its value of that time.

    It refuses all other addresses, as a PLC does that lacks them. The time of the recording begins
    at `begin`, when the first request arrives. After its end the last values stay.
    """

    def __init__(
        self, driver: AnyDriver, course: RecordedValues, begin: float, answered: Answered
    ) -> None:
        self._driver = driver
        self._station = station_of(driver)
        self._coming = sorted(course.changes, key=lambda change: change.at)[::-1]
        self._begin = begin
        self._shift: float | None = None  # from the clock of the line to that of the recording
        self._answered = answered
        self._known = frozenset(course.first)
        self._unknown: list[Unit] = []  # in the present request
        for (area, number), value in course.first.items():
            self.memory.write(area, number, [value])
        self.memory.guard = self._lacks

    @property
    def memory(self) -> Memory:
        return self._station.memory

    @property
    def delay(self) -> float:
        """Seconds that the request wants the reply to wait."""
        delay: float = getattr(self._station, "delay", 0.0)
        return delay

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if self._shift is None:
            self._shift = self._begin - now
        while self._coming and self._coming[-1].at <= now + self._shift:
            _, (area, number), value = self._coming.pop()
            self.memory.write(area, number, [value])
        self._unknown.clear()
        replies = self._station.hear(data, now)
        self._answered.requests += len(replies)
        if self._unknown:
            self._answered.unknown[self._text()] += 1
        return replies

    def _lacks(self, area: str, numbers: Sequence[int]) -> bool:
        missing = [(area, number) for number in numbers if (area, number) not in self._known]
        self._unknown += missing
        return bool(missing)

    def _text(self) -> str:
        area, number = self._unknown[0]
        return f"station {self._driver.station}: {self._driver.spell(Address(area, number))}"


class OtherStations:
    """Answers nothing, and counts the requests to stations that the recording does not hold."""

    def __init__(
        self, drivers: Sequence[Listenable], stations: set[int], answered: Answered
    ) -> None:
        readers: dict[object, TrafficReader] = {}
        for driver in drivers:
            readers.setdefault(driver.framing, driver.traffic_reader(0.0))
        self._readers = list(readers.values())
        self._stations = stations
        self._answered = answered
        self._last = -math.inf
        self.memory = Memory(())

    def hear(self, data: bytes, now: float) -> list[bytes]:
        silence, self._last = now - self._last, now
        for reader in self._readers:
            for heard in reader.feed(data, silence):
                if isinstance(heard, Asked) and heard.station not in self._stations:
                    self._answered.requests += 1
                    self._answered.unknown[f"station {heard.station}"] += 1
        return []


def units_asked(driver: AnyDriver, requests: Sequence[tuple[float, bytes]]) -> list[Unit]:
    """Returns the units that requests name, in their order. `requests`: time and bytes."""
    found: dict[Unit, None] = {}
    station = station_of(driver)

    def note(area: str, numbers: Sequence[int]) -> bool:
        found.update(dict.fromkeys((area, number) for number in numbers))
        return False

    station.memory.guard = note
    for at, data in requests:
        station.hear(data, at)
    return sorted(found)
