"""Calculates the load of each line, and the ages of its values, before anything is sent."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from gateway.engine.device.ages import load_of, polled_blocks, worst_ages
from gateway.engine.device.device import PROOF_COST, Device
from gateway.engine.device.long_writes import long_write
from gateway.engine.device.probe_pace import PAUSE_FIRST, PROBE_PAUSE
from gateway.engine.device.reply_shapes import MARK_LONGEST
from gateway.engine.schedule.probes import seen_within
from gateway.planning.planner import Block, items_of, shortest_round
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver
from gateway.protocols.unsolicited import Unsolicited
from gateway.tags import Tag

# Times that a device goes offline within a search: resyncs may read the silent address, too. Not
# more were seen in simulated searches with drawn blocks, retries, intervals and time-outs.
SEARCH_FALLS = 4


@dataclass(frozen=True, slots=True)
class BlockForecast:
    """One block: the seconds of its transaction, and the worst age of its values."""

    device: Device
    block: Block
    seconds: float
    worst_age: float


class TimedWrites(NamedTuple):
    """Writes of one tag: `often` in a second at most, each takes `seconds`."""

    often: float
    seconds: float


@dataclass(frozen=True, slots=True)
class LineForecast:
    """One line while all its devices reply. Times in seconds."""

    name: str
    wire: WireTiming
    blocks: tuple[BlockForecast, ...]
    load: float  # share of the wire time; 1.0: all of it
    load_proven: float  # the same while each read needs a proof, because extra replies arrive
    requests: float  # per second
    characters: float  # per second, both ways
    cycle: float  # one poll of every block
    worst_write: float  # from the request of the client to the acknowledgement
    worst_write_silent: float  # the same when a device does not reply
    seen_within: float  # from the return of a silent device until it is seen; all but one silent
    seen_at_worst: float  # the same while as many others reply as delay it most
    shortest: float  # the shortest interval that is possible for all tags
    unsolicited: tuple[tuple[Device, int], ...]  # devices with their number of unsolicited tags

    def with_writes(self, writes: Sequence[TimedWrites]) -> "LineForecast":
        """Returns the forecast with writes that the gateway sends by itself."""
        more = sum(one.often * one.seconds for one in writes)
        often = sum(one.often for one in writes)
        proven, requests = self.load_proven + more, self.requests + often
        return replace(self, load=self.load + more, load_proven=proven, requests=requests)

    @property
    def overloaded(self) -> bool:
        return self.load > 1

    def advice(self) -> str:
        """Returns a sentence with possible intervals; empty if the line is not overloaded."""
        if not self.overloaded:
            return ""
        shortest = math.ceil(self.shortest * 100) / 100
        return (
            f"line {self.name} is asked for {self.load:.0%} of what it can carry at "
            f"{self.wire.baudrate} baud: multiply the intervals by {self.load:.2f}, or poll all "
            f"tags every {shortest:g} s, the shortest interval for all"
        )


def forecast(name: str, devices: Sequence[Device], wire: WireTiming) -> LineForecast:
    """Calculates the forecast of a line from the plans of its devices."""
    blocks = polled_blocks(devices)
    load = load_of(blocks) + sum(map(_marks, devices))
    longest = max((one.longest for one in blocks), default=0.0)
    written = [device for device in devices if not device.settings.listen_only]
    write = max((_longest_write(device) for device in written), default=0.0)
    silence = max((device.longest_reply for device in devices), default=0.0)
    cycle = sum(one.seconds for one in blocks)
    requests = sum(1 / one.block.every for one in blocks)
    seen, seen_at_worst = seen_within(devices, load, requests, longest)
    unsolicited = [(device, _unsolicited_tags(device)) for device in devices]
    return LineForecast(
        name=name,
        wire=wire,
        blocks=tuple(
            BlockForecast(one.device, one.block, one.seconds, age)
            for one, age in zip(blocks, worst_ages(blocks), strict=True)
        ),
        load=load,
        load_proven=load + sum(device.load_of_proofs for device in devices),
        requests=requests,
        characters=sum(sum(one.block.cost) / one.block.every for one in blocks),
        cycle=cycle,
        worst_write=longest + write,
        worst_write_silent=longest + write + silence,
        seen_within=seen,
        seen_at_worst=seen_at_worst,
        shortest=sum(_round(device) for device in devices) if load > 1 else cycle,
        unsolicited=tuple((device, tags) for device, tags in unsolicited if tags),
    )


def dark_for(device: Device, load: float) -> float | None:
    """Returns the seconds for which one address without replies darkens other tags, at most.

    Its block is halved until the address is alone. None: its requests cannot be halved, or the line
    has no time left. `load`: of the line.
    """
    blocks = [block for block in device.blocks if not (block.of_fields or block.listed)]
    if load >= 1 or not blocks or len(blocks) < len(device.blocks):
        return None
    longer, retries = int(device.shapes is not None), device.timing.retries
    resync = device.seconds(PROOF_COST)

    def search(block: Block) -> float:
        levels = (len(items_of(block.tags)) - 1).bit_length()
        reads = 2 + retries + 2 * longer + levels * (1 + min(1, retries) + longer)
        waits = block.every + max(block.every, PAUSE_FIRST)
        return waits + reads * (device.longest_reply + device.seconds(block.cost) + resync)

    falls = SEARCH_FALLS * (PROBE_PAUSE + 2 * device.longest_reply)
    return (max(map(search, blocks)) + falls) / (1 - load)


def _marks(device: Device) -> float:
    """Returns the share of the wire time of the resyncs on a wire that is never quiet."""
    shortest = min((device.seconds(block.cost) for block in device.blocks), default=0.0)
    return 0.0 if device.shapes is None else shortest / MARK_LONGEST


def _unsolicited_tags(device: Device) -> int:
    """Returns the number of its tags that cannot be polled."""
    driver = device.driver
    if not isinstance(driver, Unsolicited):
        return 0
    return sum(driver.unsolicited_only(tag.span) for tag in device.tags)


def unsolicited_tags(device: Device) -> list[Tag]:
    """Returns the tags whose values arrive without a request."""
    driver = device.driver
    if device.settings.listen_only:
        return [*device.tags]
    if not isinstance(driver, Unsolicited):
        return []
    return [tag for tag in device.tags if driver.unsolicited_only(tag.span)]


def why_not_learned(driver: AnyDriver, tag: Tag) -> str:
    """Returns why no traffic can bring the value; empty if it can be learned."""
    if not driver.areas[tag.span.area].readable:
        return "it cannot be read, so no reply holds it"
    return ""


def _round(device: Device) -> float:
    """Returns the seconds of one read of all tags, planned as if all had the same interval."""
    blocks = device.blocks
    if len({tag.every for tag in device.tags}) == 1 and not any(block.listed for block in blocks):
        return sum(device.seconds(block.cost) for block in blocks)
    cuts = device.bad_addresses.cuts
    return shortest_round(device.tags, device.driver, device.transactions, cuts)


def _longest_write(device: Device) -> float:
    return max((write_seconds(device, tag) for tag in device.tags if tag.write), default=0.0)


def write_seconds(device: Device, tag: Tag) -> float:
    """Returns the seconds of all transactions of one write of the tag, with its reads."""
    driver, back = device.driver, device.driver.cost(tag.span)
    long = long_write(driver, tag.span, tag.layout.type.count)
    costs = [driver.write_cost(span) for span in ([tag.span] if long is None else long.spans)]
    seconds = sum(device.seconds(cost) for cost in costs if cost is not None)
    if back is not None:
        reads = (tag.part is not None) + (tag.write is not None and tag.write.verify)
        seconds += reads * device.seconds(back)
    return seconds
