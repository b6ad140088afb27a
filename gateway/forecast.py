"""What a configuration will do to its lines, by calculation alone: the promise `check` prints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from gateway.device import Device
from gateway.planner import Block, plan
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Tag
from gateway.wiretime import Wire


@dataclass(frozen=True, slots=True)
class BlockForecast:
    """One request: how long its exchange takes and how old its values get, in seconds."""

    device: Device
    block: Block
    seconds: float
    worst_age: float


@dataclass(frozen=True, slots=True)
class LineForecast:
    """One line while all its stations answer. Times in seconds."""

    name: str
    wire: Wire
    blocks: tuple[BlockForecast, ...]
    load: float  # 1.0: all the time the wire has
    requests: float  # per second
    characters: float  # per second, both ways
    cycle: float  # one round of every block
    worst_write: float  # from asking to the acknowledgement
    worst_write_silent: float  # the same while a station has just gone silent
    shortest: float  # the shortest interval at which all tags could be polled alike
    unasked: tuple[tuple[Device, int], ...]  # devices with tags that come unasked: how many

    @property
    def overloaded(self) -> bool:
        return self.load > 1

    def advice(self) -> str:
        """What would fit, in one sentence; empty when the file's wishes do."""
        if not self.overloaded:
            return ""
        shortest = math.ceil(self.shortest * 100) / 100
        return (
            f"line {self.name} is asked for {self.load:.0%} of what it can carry at "
            f"{self.wire.baudrate} baud: multiply the intervals by {self.load:.2f}, or poll all "
            f"tags every {shortest:g} s, the shortest interval for all"
        )


def forecast(name: str, devices: Sequence[Device], wire: Wire) -> LineForecast:
    """Reckon a line from its plan."""
    asked = [
        (device, block, device.verify_reads * device.seconds(block.cost))
        for device in devices
        for block in device.blocks
    ]
    load = sum(seconds / block.every for _, block, seconds in asked)
    longest = max((seconds for _, _, seconds in asked), default=0.0)
    write = max((_longest_write(device) for device in devices), default=0.0)
    silence = max(
        (device.timing.reply_timeout + device.late_guard for device in devices), default=0.0
    )
    rates = [(block.every, seconds) for _, block, seconds in asked]
    cycle = sum(seconds for _, seconds in rates)
    wait = _longest_wait(rates, longest, load)
    blocks = tuple(
        BlockForecast(device, block, seconds, _worst_age(block.every, seconds, wait, load))
        for device, block, seconds in asked
    )
    unasked = [
        (device, sum(tag.span.area == LISTENED for tag in device.tags)) for device in devices
    ]
    return LineForecast(
        name=name,
        wire=wire,
        blocks=blocks,
        load=load,
        requests=sum(1 / every for every, _ in rates),
        characters=sum(sum(block.cost) / block.every for _, block, _ in asked),
        cycle=cycle,
        worst_write=longest + write,
        worst_write_silent=longest + write + silence,
        shortest=sum(_round(device) for device in devices) if load > 1 else cycle,
        unasked=tuple((device, tags) for device, tags in unasked if tags),
    )


def _round(device: Device) -> float:
    """One reading of all tags, planned as if all had the same interval."""
    alike = [replace(tag, every=1.0) for tag in device.tags]
    blocks = plan(alike, device.driver, device.seconds, device.refusals.cuts)
    return sum(device.seconds(block.cost) for block in blocks)


def _longest_wait(rates: Sequence[tuple[float, float]], longest: float, load: float) -> float:
    """The longest the line can be busy without a pause: nobody due waits longer than that.

    The usual fixed point: an exchange just begun, then everything that comes due meanwhile.
    """
    if load >= 1:
        return math.inf
    busy = longest
    for _ in range(1000):
        later = longest + sum(math.ceil(busy / every) * seconds for every, seconds in rates)
        if later <= busy:
            return busy
        busy = later
    return math.inf


def _worst_age(every: float, seconds: float, wait: float, load: float) -> float:
    """Just before the next value arrives. By earliest deadline no poll waits beyond its period
    while the line carries its load; beyond that all periods stretch alike."""
    if load > 1:
        return 2 * every * load + seconds
    return every + min(every, wait) + seconds


def _longest_write(device: Device) -> float:
    return max((_write_seconds(device, tag) for tag in device.tags if tag.write), default=0.0)


def _write_seconds(device: Device, tag: Tag) -> float:
    """All exchanges of one write of the tag: change a bit, read back."""
    cost, back = device.driver.write_cost(tag.span), device.driver.cost(tag.span)
    seconds = 0.0 if cost is None else device.seconds(cost)
    if back is not None:
        reads = (tag.address.bit is not None) + (tag.write is not None and tag.write.verify)
        seconds += reads * device.seconds(back)
    return seconds
