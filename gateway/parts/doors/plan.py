"""The part of `check` about doors: who can ask which devices, and what it does to the line."""

from collections.abc import Iterator, Mapping, Sequence

from gateway.config import Config
from gateway.engine.device.ages import polled_blocks, worst_ages
from gateway.engine.device.device import Device
from gateway.engine.forecast import LineForecast
from gateway.parts.doors.settings import ALONE, Door, Sharing
from gateway.protocols.driver import Address, AnyDriver, Span
from gateway.protocols.ranges import spans

_MOST_READ = 2000  # points; no protocol reads more at once


def door_plans(config: Config, lines: Sequence[LineForecast]) -> Iterator[str]:
    """Yields a text for each door of the file."""
    planned = {line.name: line for line in lines}
    for door in _doors(config):
        if door.protocol in ALONE:
            yield (
                f"door {door.name}: a program at {door.listens} gets the wire "
                f"of line {door.line} alone; its values are then bad (maintenance)"
            )
            continue
        devices = {one.name: one.driver for one in door.stations(config).values()}
        written = "; ".join(_written(door, devices)) or "nothing"
        stations = ", ".join(f"{name} ({one.station})" for name, one in devices.items())
        yield (
            f"door {door.name}: programs at {door.listens} ask {stations} "
            f"by {door.protocol}, and may write {written}\n"
            f"  they get at most {door.most:.0%} of line {door.line}"
            f"{_ages(door, planned.get(door.line), [*devices.values()])}{_spared(door)}"
        )


def door_warnings(config: Config, lines: Sequence[LineForecast]) -> list[str]:
    """Returns a sentence for each line that cannot carry its polls and its doors."""
    most: dict[str, float] = {}
    for door in _doors(config):
        if door.protocol not in ALONE:
            most[door.line] = max(most.get(door.line, 0.0), door.most)
    return [
        f"line {line.name} is asked for {line.load + most[line.name]:.0%} of what it can carry "
        "while programs use their share: its values are then older than above; write a smaller "
        "`most`, or longer intervals"
        for line in lines
        if line.name in most and line.load <= 1 < line.load + most[line.name]
    ]


def _doors(config: Config) -> Sequence[Door]:
    sharing = config.part(Sharing)
    return () if sharing is None else sharing.doors


def _written(door: Door, devices: Mapping[str, AnyDriver]) -> Iterator[str]:
    for name, written in door.writes.items():
        if name in devices and written:
            yield f"{name} {', '.join(_spelt(devices[name], span) for span in written)}"


def _ages(door: Door, line: LineForecast | None, drivers: Sequence[AnyDriver]) -> str:
    """Returns what the programs do to the load and to the ages of the line."""
    if line is None:
        return ""
    load = line.load + door.most
    text = f": its load is then {load:.0%}"
    devices = {one.device.driver: one.device for one in line.blocks}
    longest = max((_longest(devices[one]) for one in drivers if one in devices), default=0.0)
    ages = worst_ages(polled_blocks([*devices.values()]), door.most, longest)
    if load >= 1 or not ages:
        return text
    more = max(age - one.worst_age for one, age in zip(line.blocks, ages, strict=True))
    return f"{text}, and its worst ages grow by {more:.2g} s"


def _longest(device: Device) -> float:
    """Returns the seconds of the longest read that a program can ask for."""
    driver, found = device.driver, 0.0
    for area in driver.areas.values():
        if area.readable:
            numbers = range(area.first, min(area.last + 1, area.first + _MOST_READ))
            cost = driver.cost(next(spans(driver, area.name, numbers)))
            found = max(found, 0.0 if cost is None else device.seconds(cost))
    return found


def _spared(door: Door) -> str:
    if not door.max_age:
        return ""
    return f"\n  polled addresses are answered by values of the last {door.max_age:g} s"


def _spelt(driver: AnyDriver, span: Span) -> str:
    first = driver.spell(Address(span.area, span.start))
    last = driver.spell(Address(span.area, span.start + span.size - 1))
    return first if first == last else f"{first}..{last}"
