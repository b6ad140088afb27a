"""Simulated PLCs with faults, and a record of their memory over time.

Every moving word counts milliseconds from its own offset. So a value that is too old, or from
another address or station, differs from the expected one.
"""

import asyncio
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from gateway.protocols.driver import AnyDriver, Span, Unit
from gateway.protocols.frames import FrameDriver
from gateway.simulator.plant import station_for
from gateway.stations.station import Memory, Station
from gateway.tags import Tag
from gateway.values import Value
from tests.sim.arrays import BLINK, Clocks, shown
from tests.sim.gadgets import Gadget, wrapping_of
from tests.sim.manners import SILENT, Holes, Manners, is_unknown, outside, refusal
from tests.sim.requests import shape_of

SLACK = 2  # ms: moments are rounded to milliseconds on both sides


def offset(station: int, area: str, number: int) -> int:
    """Returns milliseconds, different for every address of every station."""
    return (number * 7919 + station * 27_644_437 + sum(area.encode()) * 104_729) % 2**32


def milliseconds(now: float) -> int:
    return int(now * 1000)


def moving(
    station: int, area: str, number: int, unit: Unit, part: int = 0, coarse: int = 0
) -> Callable[[float], int]:
    """Returns the unit at `number + part` of the clock that begins at `number`."""
    own = offset(station, area, number)
    if unit is Unit.BIT:
        return lambda now: (milliseconds(now) + own) // BLINK & 1
    if unit is Unit.DWORD:
        return lambda now: _hashed((milliseconds(now) + own) >> coarse, own, coarse) & 0xFFFF_FFFF
    shift = 16 * part
    return lambda now: _hashed((milliseconds(now) + own) >> coarse, own, coarse) >> shift & 0xFFFF


def _hashed(step: int, own: int, coarse: int) -> int:
    """Returns the value of the clock at a step: the step, or any number where it is coarse."""
    return (step * 2_654_435_761 + own) % 2**32 if coarse else step


@dataclass(eq=False)
class Troubled:
    """One station on the wire, with its faults."""

    number: int
    inner: Station
    chance: random.Random
    character: float
    turnaround: float = 0.005
    listens_after: float = 0.0  # seconds after any reply for which it does not listen
    drives_for: float = 0.0  # seconds after its reply for which it damages the next request
    deaf: bool = False  # receives nothing: switched off, or without its cable
    mute: bool = False  # carries out requests; its replies are lost
    lose: float = 0.0  # share of lost replies
    cut: float = 0.0  # share of replies that break off
    junk: float = 0.0  # share of replies after meaningless bytes
    foreign: float = 0.0  # share of replies replaced by another station's last
    late: Callable[[random.Random], float] | None = None  # seconds more than usual
    twice: float = 0.0  # share of replies that arrive twice
    other: random.Random = field(default_factory=random.Random)  # for `twice`
    refusing: str = ""  # the code with which it refuses all reads
    manners: Manners = field(default_factory=Manners)
    outside: list[tuple[str, int, int]] = field(default_factory=list)  # ranges it does not have
    protocol: str = ""
    last: bytes = b""
    others: list["Troubled"] = field(default_factory=list)
    written: dict[tuple[str, int], list[tuple[float, int]]] = field(default_factory=dict)
    coarse: int = 0  # bits left out of its clocks: values that change rarely
    numbered: bool = False  # replies carry a number: a foreign one is an older one of its own
    ordered: bool = True  # replies keep the order of the requests
    missing: set[tuple[str, int]] = field(default_factory=set)  # addresses it refuses
    absent: dict[tuple[str, int], list[list[float]]] = field(default_factory=dict)  # since, until

    def __post_init__(self) -> None:
        self._busy_until = 0.0
        self._replied_at = 0.0
        self._now = 0.0
        self.broke_off = False  # the last answer
        self.computed: set[tuple[str, int]] = set()  # written by its own program
        self._remember_writes(self.inner.memory)
        for where in self.missing:
            self.absent[where] = [[0.0, float("inf")]]

    def _remember_writes(self, memory: Memory) -> None:
        plain = memory.write

        def write(area: str, start: int, values: list[int]) -> None:
            values = list(values)
            if any((area, start + i) in self.computed for i in range(len(values))):
                return  # its own program writes it
            for i, value in enumerate(values):
                self.written.setdefault((area, start + i), []).append((self._now, value))
            plain(area, start, values)

        memory.write = write  # type: ignore[method-assign,assignment]  # the only place to observe writes

    def hear(self, data: bytes, now: float) -> tuple[bytes, float] | None:
        if self.deaf or (self.manners.single and now < self._replied_at):
            return None
        self._now = now
        said = self._mannered(data, b"".join(self.inner.hear(data, now)))
        if not said:
            return None
        chance = self.chance
        before, real, self.last, self.broke_off = self.last, said, said, False
        if self.mute or (self.lose and chance.random() < self.lose):
            return None
        if self.foreign and chance.random() < self.foreign:
            others = b"" if self.numbered else next((o.last for o in self.others if o.last), b"")
            said = others or (before if self.numbered else b"") or said
        if self.cut and chance.random() < self.cut:
            said = said[: chance.randrange(1, len(said))]
            self.broke_off = True
        if self.junk and chance.random() < self.junk:
            said = chance.randbytes(chance.randrange(1, 6)) + said
        delay = self.turnaround + (self.late(chance) if self.late and said is real else 0.0)
        if self.ordered:
            delay = max(delay, self._busy_until - now)  # as a PLC's do
        self._replied_at = now + delay + len(said) * self.character
        self._busy_until = self._replied_at + 0.002
        return said, delay

    def _mannered(self, data: bytes, said: bytes) -> bytes:
        """Returns the reply as this station sends it, refusals in its own way."""
        if self.refusing and said and shape_of(self.protocol, data) is not None:
            return refusal(self.inner, said, self.refusing)
        unknown = self.manners.unknown
        if unknown and said and is_unknown(self.inner, said):
            return b"" if unknown == SILENT else refusal(self.inner, said, unknown)
        return said

    def copies(self) -> list[tuple[float, bool]]:
        """Returns the copies of its last reply: seconds after it, and if they are on the wire."""
        if not self.twice or self.other.random() >= self.twice:
            return []
        after = self.other.choice((0.0, 0.002, 0.02, 0.06, 0.2, 1.0)) * self.other.uniform(0.5, 1)
        return [(after, self.other.random() < 0.3)]

    @property
    def speaks(self) -> bool:
        """A reply is due, or is being sent."""
        return _now() < self._busy_until

    def well(self) -> None:
        self.deaf = self.mute = False
        self.lose = self.cut = self.junk = self.foreign = 0.0
        self.late = None

    # The record

    def holds(self, tag: Tag) -> list[int]:
        area, start, size = tag.span
        return self.inner.memory.read(area, start, size, self._now)

    def vanish(self, tag: Tag) -> None:
        """Removes the addresses of the tag."""
        for where in _places(tag):
            self.missing.add(where)
            self.absent.setdefault(where, []).append([_now(), float("inf")])
        set_holes(self.inner, self.missing, self.outside)

    def come_back(self, tag: Tag) -> None:
        for where in _places(tag):
            self.missing.discard(where)
            self.absent[where][-1][1] = _now()
        set_holes(self.inner, self.missing, self.outside)

    def has(self, span: Span) -> bool:
        """The station has all addresses of the span."""
        area, start, size = span
        return not any(
            (area, n) in self.missing
            or any(area == name and first <= n <= last for name, first, last in self.outside)
            for n in range(start, start + size)
        )

    def lacks(self, tag: Tag) -> bool:
        return not self.missing.isdisjoint(_places(tag))

    def lacked(self, tag: Tag, since: float, until: float) -> bool:
        """The tag was absent during the whole time."""
        return any(
            begin <= since and until <= end
            for where in _places(tag)
            for begin, end in self.absent.get(where, ())
        )

    def changed(self, tag: Tag, since: float) -> bool:
        """The tag appeared or disappeared since then."""
        return any(
            since <= moment
            for where in _places(tag)
            for span in self.absent.get(where, ())
            for moment in span
            if moment < float("inf")
        )

    def was(self, tag: Tag, value: Value, since: float, until: float) -> bool:
        """The tag had this value at some time in between."""
        area, start, _ = tag.span
        if self.lacked(tag, since, until):
            return False
        if tag.write is not None or (area, start) not in self.computed:
            return self._was_written(tag, value, since, until)
        first, last = milliseconds(since) - SLACK, milliseconds(until) + SLACK
        if tag.layout.type.count:
            return clocks_of(self, tag).had(value, first, last)
        own = offset(self.number, area, start)
        if tag.unit_kind is Unit.BIT:
            seen = {(ms + own) // BLINK & 1 for ms in (first, last)}
            return len(seen) == 2 or last - first >= BLINK or bool(value) == bool(seen.pop())
        if self.coarse:
            return any(tag.decode(units) == value for units in self._steps(tag, own, first, last))
        if tag.address.bit is not None:
            turns = {(ms + own) >> tag.address.bit for ms in (first, last)}
            return len(turns) == 2 or bool(value) == bool(turns.pop() & 1)
        if not isinstance(value, (int, float)):
            return False
        bits = 32 if tag.unit_kind is Unit.DWORD or tag.span.size == 2 else 16
        raw = round((value - tag.shaping.offset) / tag.shaping.scale)
        return (raw - own - first) % (1 << bits) <= last - first

    def _steps(self, tag: Tag, own: int, first: int, last: int) -> Iterator[list[int]]:
        """Yields the values of its clock from `first` to `last`, in milliseconds."""
        for step in range((first + own) >> self.coarse, ((last + own) >> self.coarse) + 1):
            number = _hashed(step, own, self.coarse)
            if tag.unit_kind is Unit.DWORD:
                yield [number]
            else:
                yield [number >> 16 * part & 0xFFFF for part in range(tag.span.size)]

    def _was_written(self, tag: Tag, value: Value, since: float, until: float) -> bool:
        area, start, size = tag.span
        histories = [self.written.get((area, start + i), [(0.0, 0)]) for i in range(size)]
        moments = {since}
        for history in histories:
            recent = takewhile(lambda write: write[0] > since, reversed(history))
            moments |= {at for at, _ in recent if at <= until}
        for moment in moments:
            units = [
                next((unit for at, unit in reversed(history) if at <= moment), 0)
                for history in histories
            ]
            if shown(tag, units) == value:
                return True
        return False


def station_of(driver: AnyDriver, device: str) -> Station:
    """Makes the station for a driver, with an empty memory."""
    if isinstance(driver, FrameDriver):
        return Gadget(device[-1], wrapping_of(driver.settings.framing))
    return station_for(driver, ())


def clocks_of(station: Troubled, tag: Tag) -> Clocks:
    """Returns the clocks of an array: each element has that of its address."""
    area, start, size = tag.span
    step = size // tag.layout.type.count
    own = tuple(offset(station.number, area, start + n) for n in range(0, size, step))
    return Clocks(tag, own, station.coarse)


def set_going(
    station: Troubled, tags: Sequence[Tag], areas: Iterable[str] = (), others: Sequence[Tag] = ()
) -> None:
    """Makes every tag move, except those that can be written.

    `areas`: all of the station; `others`: tags of broadcasts, which it has too.
    """
    memory = station.inner.memory
    written = {place for tag in tags if tag.write is not None for place in _places(tag)}
    for tag in tags:
        area, start, size = tag.span
        if not memory.holds(area, start, size):
            raise AssertionError(f"{tag.text} is not in the simulated station")
        if tag.write is not None:
            memory.write(area, start, [0] * size)
            continue
        if not written.isdisjoint(_places(tag)):
            continue  # one element of an array that is written
        clocks = clocks_of(station, tag) if tag.layout.type.count else None
        for part in range(size):
            kind = tag.unit_kind
            motion = moving(station.number, area, start, kind, part, station.coarse)
            if clocks is not None:
                motion = clocks.unit(part)
            memory.animate(area, start + part, motion)
            station.computed.add((area, start + part))
    # A PLC always has its own flags.
    plain = [area for area in areas if area not in ("M8", "D8")]
    station.outside = outside(station.manners.has, [*tags, *others], plain)
    set_holes(station.inner, station.missing, station.outside)


def _places(tag: Tag) -> list[tuple[str, int]]:
    return [(tag.span.area, tag.span.start + i) for i in range(tag.span.size)]


def _now() -> float:
    return asyncio.get_running_loop().time()


def set_holes(
    station: Station, missing: set[tuple[str, int]], ranges: list[tuple[str, int, int]]
) -> None:
    """Sets the addresses (area, number) and ranges that the station refuses."""
    lacks = Holes(frozenset(missing), tuple(ranges)) if ranges else set(missing)
    station.memory.holes = lacks  # type: ignore[assignment]  # ranges would be long sets
