"""Simulated PLCs with faults, and the truth about what was in them when.

Every word that moves says what time it is, in milliseconds, by an offset of its own: a value
that is too old, or from another address or another station, is not what it should be.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.protocols.driver import AnyDriver, Unit
from gateway.simulation import station_for
from gateway.stations.station import Memory, Station
from gateway.tags import Tag
from gateway.values import Value

BLINK = 4096  # ms that a moving bit stays as it is
SLACK = 2  # ms: moments are rounded to milliseconds on both sides


def offset(station: int, area: str, number: int) -> int:
    """In milliseconds, different for every address of every station."""
    return (number * 7919 + station * 27_644_437 + sum(area.encode()) * 104_729) % 2**32


def milliseconds(now: float) -> int:
    return int(now * 1000)


def moving(
    station: int, area: str, number: int, unit: Unit, part: int = 0
) -> Callable[[float], int]:
    """What the unit at `number + part` shows of the clock that begins at `number`."""
    own = offset(station, area, number)
    if unit is Unit.BIT:
        return lambda now: (milliseconds(now) + own) // BLINK & 1
    if unit is Unit.DWORD:
        return lambda now: (milliseconds(now) + own) & 0xFFFF_FFFF
    return lambda now: (milliseconds(now) + own) >> 16 * part & 0xFFFF


@dataclass(eq=False)
class Troubled:
    """One station on the wire and what is wrong with it just now."""

    number: int
    inner: Station
    chance: random.Random
    character: float
    turnaround: float = 0.005
    deaf: bool = False  # does not hear: switched off, or the cable is out
    mute: bool = False  # obeys, but is not heard
    lose: float = 0.0  # share of answers that are lost
    cut: float = 0.0  # share of answers that break off
    junk: float = 0.0  # share of answers with bytes before them that mean nothing
    foreign: float = 0.0  # share of answers in whose place another station's last one is sent
    late: Callable[[random.Random], float] | None = None  # seconds more than usual
    last: bytes = b""
    others: list["Troubled"] = field(default_factory=list)
    written: dict[tuple[str, int], list[tuple[float, int]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._busy_until = 0.0
        self._now = 0.0
        self._remember_writes(self.inner.memory)

    def _remember_writes(self, memory: Memory) -> None:
        plain = memory.write

        def write(area: str, start: int, values: list[int]) -> None:
            values = list(values)
            for i, value in enumerate(values):
                self.written.setdefault((area, start + i), []).append((self._now, value))
            plain(area, start, values)

        memory.write = write  # type: ignore[method-assign,assignment]  # the only way to look in

    def hear(self, data: bytes, now: float) -> tuple[bytes, float] | None:
        if self.deaf:
            return None
        self._now = now
        said = b"".join(self.inner.hear(data, now))
        if not said:
            return None
        chance = self.chance
        real, self.last = said, said
        if self.mute or (self.lose and chance.random() < self.lose):
            return None
        if self.foreign and chance.random() < self.foreign:
            said = next((other.last for other in self.others if other.last), b"") or said
        if self.cut and chance.random() < self.cut:
            said = said[: chance.randrange(1, len(said))]
        if self.junk and chance.random() < self.junk:
            said = chance.randbytes(chance.randrange(1, 6)) + said
        delay = self.turnaround + (self.late(chance) if self.late and said is real else 0.0)
        delay = max(delay, self._busy_until - now)  # answers keep their order, as a PLC's do
        self._busy_until = now + delay + len(said) * self.character + 0.002
        return said, delay

    def well(self) -> None:
        self.deaf = self.mute = False
        self.lose = self.cut = self.junk = self.foreign = 0.0
        self.late = None

    # The truth

    def holds(self, tag: Tag) -> list[int]:
        area, start, size = tag.span
        return self.inner.memory.read(area, start, size, self._now)

    def was(self, tag: Tag, value: Value, since: float, until: float) -> bool:
        """Whether the tag had this value at some moment between the two."""
        area, start, _ = tag.span
        if tag.write is not None:
            return self._was_written(tag, value, since, until)
        first, last = milliseconds(since) - SLACK, milliseconds(until) + SLACK
        own = offset(self.number, area, start)
        if tag.unit_kind is Unit.BIT:
            seen = {(ms + own) // BLINK & 1 for ms in (first, last)}
            return len(seen) == 2 or last - first >= BLINK or bool(value) == bool(seen.pop())
        if tag.address.bit is not None:
            shift = tag.address.bit
            turns = {(ms + own) >> shift for ms in (first, last)}
            return len(turns) == 2 or bool(value) == bool(turns.pop() & 1)
        if not isinstance(value, (int, float)):
            return False
        bits = 32 if tag.unit_kind is Unit.DWORD or tag.span.size == 2 else 16
        raw = round((value - tag.offset) / tag.scale)
        return (raw - own - first) % (1 << bits) <= last - first

    def _was_written(self, tag: Tag, value: Value, since: float, until: float) -> bool:
        area, start, size = tag.span
        histories = [self.written.get((area, start + i), [(0.0, 0)]) for i in range(size)]
        moments = {
            since,
            *(at for history in histories for at, _ in history if since < at <= until),
        }
        for moment in moments:
            units = [
                next((unit for at, unit in reversed(history) if at <= moment), 0)
                for history in histories
            ]
            if tag.decode(units) == value:
                return True
        return False


def station_of(driver: AnyDriver, tags: tuple[Tag, ...], missing: set[tuple[str, int]]) -> Station:
    """A station in which every tag moves, but those that can be written."""
    station = station_for(driver, ())
    for tag in tags:
        area, start, size = tag.span
        if not station.memory.holds(area, start, size):
            raise AssertionError(f"{tag.text} is not in the simulated station")
        if tag.write is None:
            for part in range(size):
                motion = moving(driver.station, area, start, tag.unit_kind, part)
                station.memory.animate(area, start + part, motion)
    set_holes(station, missing)
    return station


def set_holes(station: Station, missing: set[tuple[str, int]]) -> None:
    """Addresses (area, number) that the station refuses from now on."""
    if hasattr(station, "_store"):
        holes = tuple((area, number, number) for area, number in sorted(missing))
        station._store._holes = holes
    else:
        station.holes = set(missing)  # type: ignore[attr-defined]  # Vigor and Computer Link
