"""What a configuration will do to its lines, by calculation alone: the promise `check` prints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from gateway.engine.ages import asked, load_of, worst_ages
from gateway.engine.device import Device
from gateway.planning.planner import Block, plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.unsolicited import Unsolicited
from gateway.tags import Tag


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
    wire: WireTiming
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


def forecast(name: str, devices: Sequence[Device], wire: WireTiming) -> LineForecast:
    """Reckon a line from its plan."""
    blocks = asked(devices)
    load = load_of(blocks)
    longest = max((one.seconds for one in blocks), default=0.0)
    write = max((_longest_write(device) for device in devices), default=0.0)
    silence = max((device.longest_reply for device in devices), default=0.0)
    cycle = sum(one.seconds for one in blocks)
    unasked = [(device, _unsolicited(device)) for device in devices]
    return LineForecast(
        name=name,
        wire=wire,
        blocks=tuple(
            BlockForecast(*one, age) for one, age in zip(blocks, worst_ages(blocks), strict=True)
        ),
        load=load,
        requests=sum(1 / one.block.every for one in blocks),
        characters=sum(sum(one.block.cost) / one.block.every for one in blocks),
        cycle=cycle,
        worst_write=longest + write,
        worst_write_silent=longest + write + silence,
        shortest=sum(_round(device) for device in devices) if load > 1 else cycle,
        unasked=tuple((device, tags) for device, tags in unasked if tags),
    )


def _unsolicited(device: Device) -> int:
    """The number of its tags that cannot be polled."""
    driver = device.driver
    if not isinstance(driver, Unsolicited):
        return 0
    return sum(driver.unsolicited_only(tag.span) for tag in device.tags)


def _round(device: Device) -> float:
    """One reading of all tags, planned as if all had the same interval."""
    alike = [replace(tag, every=1.0) for tag in device.tags]
    blocks = plan(alike, device.driver, device.seconds, device.bad_addresses.cuts)
    return sum(device.seconds(block.cost) for block in blocks)


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
