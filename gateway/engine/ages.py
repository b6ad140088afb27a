"""How old the values of a line get: what `check` promises of a line that answers."""

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

from gateway.engine.device import Device
from gateway.planning.planner import Block


class Asked(NamedTuple):
    """One block on its line: `seconds` of the wire each time."""

    device: Device
    block: Block
    seconds: float


def asked(devices: Sequence[Device]) -> list[Asked]:
    """What their plans ask."""
    return [asked_of(device, block) for device in devices for block in device.blocks]


def asked_of(device: Device, block: Block) -> Asked:
    """One block, read as often as its device wants to be believed."""
    return Asked(device, block, device.settings.verify_reads * device.seconds(block.cost))


def load_of(blocks: Sequence[Asked]) -> float:
    """1.0: all the time the wire has."""
    return sum(one.seconds / one.block.every for one in blocks)


def worst_ages(blocks: Sequence[Asked]) -> list[float]:
    """In seconds, just before the next value arrives, while nothing is written.

    By earliest deadline no poll waits beyond its period while the line carries its load.
    Beyond that it is an estimate: in 126 lines drawn at random it held for 114, and the ages of
    the others were at most a quarter above it.
    """
    load = load_of(blocks)
    if load > 1:
        return _overloaded(blocks)
    wait = _longest_wait(blocks) if load < 1 else math.inf
    return [one.block.every + min(one.block.every, wait) + one.seconds for one in blocks]


def _longest_wait(blocks: Sequence[Asked]) -> float:
    """The longest the line can be busy without a pause: nobody due waits longer than that.

    The usual fixed point: an exchange just begun, then everything that comes due meanwhile.
    """
    longest = max((one.seconds for one in blocks), default=0.0)
    busy = longest
    for _ in range(100):
        later = longest + sum(math.ceil(busy / one.block.every) * one.seconds for one in blocks)
        if later <= busy:
            return busy
        busy = later
    return math.inf


def _overloaded(blocks: Sequence[Asked]) -> list[float]:
    """A poll is asked when it is late, two periods after it was asked last, and then waits.

    Those of one device wait alike, as the earliest deadline goes first. Of several devices with
    late polls the one that used the wire least goes first: each gets the same share, but for
    those that need less, and has to wait while all that is late of those is asked at once.
    """
    own = defaultdict[Device, list[Asked]](list)
    for one in blocks:
        own[one.device].append(one)
    needs = {device: load_of(asked) / 2 for device, asked in own.items()}
    rounds = {device: sum(one.seconds for one in asked) for device, asked in own.items()}
    waits = dict[Device, float]()
    left = 1.0
    for n, device in enumerate(sorted(needs, key=needs.__getitem__)):
        share = min(needs[device], left / (len(needs) - n))
        left -= share
        first = sum(rounds[other] for other in needs if needs[other] <= needs[device])
        waits[device] = _wait(own[device], share) + first
    return [2 * one.block.every + waits[one.device] + one.seconds for one in blocks]


def _wait(blocks: Sequence[Asked], share: float) -> float:
    """How late polls are asked that together have this share of the wire's time."""

    def needed(late: float) -> float:
        return sum(one.seconds / (2 * one.block.every + late) for one in blocks)

    if needed(0.0) <= share:
        return 0.0
    low, high = 0.0, sum(one.seconds for one in blocks) / share
    while high - low > 0.001 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if needed(middle) > share else (low, middle)
    return high
