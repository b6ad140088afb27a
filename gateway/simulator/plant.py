"""The built-in simulated plant: a PLC for every device of a file, with values that move."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

from gateway.errors import BadValue
from gateway.protocols.driver import AnyDriver
from gateway.stations.registry import station_of
from gateway.stations.station import Memory, Station
from gateway.tags import Tag
from gateway.values import Kind, Value


def station_for(driver: AnyDriver, tags: Iterable[Tag]) -> Station:
    """Returns a simulated PLC for the driver; its tags move unless they are writable."""
    station = station_of(driver)
    animate(station, tags)
    return station


def animate(station: Station, tags: Iterable[Tag]) -> None:
    """Lets the values of tags move, unless they are writable."""
    for number, tag in enumerate(tags):
        _animate(station.memory, tag, number)


def _animate(memory: Memory, tag: Tag, number: int) -> None:
    area, start, size = tag.span
    if (first := tag.element) is not None:
        step = first.span.size
        for place in range(size // step):
            span = first.span._replace(start=start + place * step)
            _animate(memory, replace(first, span=span), number + place)
        return
    if not memory.holds(area, start, size):
        return
    if tag.part is not None:
        if tag.write is None:
            memory.animate(area, start, lambda now: int(now) & 0xFFFF)
        return
    motion = _motion(tag, number)
    try:
        units = tag.encode(motion(0.0))
    except BadValue:
        return  # the limits of the tag exclude this value
    if tag.write is not None or tag.layout.type.is_text:
        memory.write(area, start, units)
        return
    for i in range(size):
        memory.animate(area, start + i, _Unit(tag, motion, i))


@dataclass(frozen=True, slots=True, eq=False)
class _Unit:
    """One unit of a value that moves."""

    tag: Tag
    motion: Callable[[float], Value]
    place: int

    def __call__(self, now: float) -> int:
        return self.tag.encode(self.motion(now))[self.place]


def _motion(tag: Tag, number: int) -> Callable[[float], Value]:
    """Returns the value of the tag as a function of time; each tag moves differently."""
    kind = tag.layout.type.kind
    if kind is Kind.TELEPHONE:
        return lambda now: "2620-4976"
    if kind is Kind.STRING:
        return lambda now: "SIMULATED"[: tag.layout.type.length]
    if kind is Kind.BOOL:
        return lambda now: int(now / (_period(number) / 8)) % 2 == 1
    low, high = 10.0, 90.0
    if tag.write is not None:
        low = low if tag.write.min is None else tag.write.min
        high = max(low, high if tag.write.max is None else tag.write.max)
    whole = not kind.value.startswith("float") and tag.shaping.scale == 1
    return _wave(low, high, number, whole=whole)


def _period(number: int) -> float:
    return 60.0 + 7 * (number % 11)  # an alarm at a limit of each is no flood


@lru_cache(maxsize=1024)
def _wave(low: float, high: float, number: int, *, whole: bool) -> Callable[[float], Value]:
    """Returns a sine between the limits, shared by tags of the same number of all devices."""
    period, digits = _period(number), None if whole else 3

    def wave(now: float) -> Value:
        value = low + (high - low) * (0.5 + 0.5 * math.sin(2 * math.pi * now / period + number))
        return round(value, digits)

    return wave
