"""Processor time of planning: `python -m benchmarks.planning`.

It plans registers of one Modbus device at 19200 baud, in rows of several shapes. They have one
interval, or a random one for each register, which is the hardest case. It prints the processor
time for ten thousand registers (`--registers`), and its ratio to the time for a tenth of them. Then
it plans fewer registers, two of three at random, on a network. Characters cost almost nothing
there, so that the planner has many requests to choose from.
"""

import argparse
import random
import time
from dataclasses import replace
from functools import partial

from benchmarks.words import words
from gateway.planning.area_items import Seconds
from gateway.planning.planner import plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Tag

DRIVER = ModbusRtu(station=1)
SECONDS = partial(WireTiming(19200, 11).transaction, timing=DRIVER.timing, turnaround=0.010)
NETWORK = partial(WireTiming(10_000_000, 10).transaction, timing=DRIVER.timing, turnaround=0.005)
INTERVALS = {1: [1.0], 2: [1.0, 10.0], 3: [0.5, 1.0, 5.0], 5: [0.2, 0.5, 1.0, 5.0, 60.0]}


def registers(shape: str, count: int) -> list[int]:
    rng = random.Random(shape)
    match shape:
        case "one row":
            return list(range(count))
        case "every third":
            return list(range(0, 3 * count, 3))
        case "100 in a row, 50 at every second, 50 at every tenth":
            few = [*range(100), *range(200, 300, 2), *range(400, 900, 10)]
            return [1300 * n + one for n in range(-(-count // len(few))) for one in few][:count]
        case "gaps at random":
            found, at = [], 0
            for _ in range(count):
                at += 1 + rng.choice([0, 0, 0, 1, 5, 20])
                found.append(at)
            return found
        case "two of three":
            return sorted(rng.sample(range(3 * count // 2), count))
    raise ValueError(shape)


SHAPES = (
    "one row",
    "every third",
    "100 in a row, 50 at every second, 50 at every tenth",
    "gaps at random",
)


def tags(shape: str, count: int, intervals: list[float]) -> list[Tag]:
    rng = random.Random(f"{shape} {intervals}")
    alike = words("holding", registers(shape, count), intervals[0])
    return [replace(tag, every=rng.choice(intervals)) for tag in alike]


def took(shape: str, count: int, intervals: list[float], seconds: Seconds = SECONDS) -> float:
    """Returns the seconds of processor time."""
    wanted = tags(shape, count, intervals)
    begun = time.process_time()
    plan(wanted, DRIVER, seconds)
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--registers", type=int, default=10_000)
    most = parser.parse_args().registers
    took("one row", most // 10, [1.0])  # warm
    print(f"| row | intervals | s for {most:,} | x of {most // 10:,} |")
    print("|---|---|---|---|")
    for shape in SHAPES:
        for number, intervals in INTERVALS.items():
            small = min(took(shape, most // 10, intervals) for _ in range(3))
            large = min(took(shape, most, intervals) for _ in range(2))
            print(f"| {shape} | {number} | {large:.2f} | {large / small:.1f} |", flush=True)
    print("\n| registers on a network | intervals | s |\n|---|---|---|")
    for count in (most // 20, most // 5):
        for intervals in (*INTERVALS.values(), [0.1, *INTERVALS[5]]):
            spent = took("two of three", count, intervals, NETWORK)
            print(f"| {count} | {len(intervals)} | {spent:.2f} |", flush=True)


if __name__ == "__main__":
    main()
