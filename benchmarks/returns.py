"""Silent stations on one line: how soon they are seen again, and the cost for the others.

`python -m benchmarks.returns` runs 32 Vigor stations on virtual time, of which one is alive (the
last in the file). Others come back at random times, one after the other. It prints the time until
the healthy station is read after the start and after a reset of the port, the time until a
returned station is read, the share of the healthy station's polls that were done, and the longest
write to it. Beside them are the limits that `check` prints.

With `--at-once` all 31 return at the same moment, on a line that is asked every 20 s. It prints
when half and all of them are read, the time of all polls, and the longest of 100 writes to the
healthy station while they were silent.

`--before` names a checkout of another version: both are then measured in turn.
"""

import argparse
import asyncio
import logging
import random
from collections.abc import Callable
from pathlib import Path

import structlog

from gateway.engine.forecast import forecast
from gateway.planning.wire_timing import WireTiming
from gateway.tags import WriteRule
from tests.sim.plant import Plant, device, make_tag, plant, running, words
from tests.sim.virtual import now, run_virtual

STATIONS, EVERY, SELDOM, SETTLED = 32, 1.0, 20.0, 120.0
PRESENT = 30.0  # seconds for which a returned station stays


async def until(true: Callable[[], bool], most: float = 600.0) -> float:
    """Returns the seconds until it is true."""
    begun = now()
    while not true() and now() - begun < most:
        await asyncio.sleep(0.02)
    return now() - begun


def silent_plant(baudrate: int, turnaround: float, seed: int, every: float = EVERY) -> Plant:
    wire = WireTiming(baudrate, 10)
    devices = []
    for station in range(1, STATIONS + 1):
        tags = words(0, 20, every=every, device=f"plc{station}")
        tags.append(make_tag("D500", every=every, device=f"plc{station}", write=WriteRule()))
        devices.append(device(tags, station=station, wire=wire))
    line = plant(devices, wire=wire, seed=seed)
    for each in line.stations:
        each.mute = True
        if turnaround:
            each.late = lambda _: turnaround
    line.stations[-1].mute = False
    return line


async def measure(baudrate: int, turnaround: float, returns: int, seed: int) -> list[str]:
    chance, line = random.Random(seed), silent_plant(baudrate, turnaround, seed)
    healthy, seen, writes = line.devices[-1], list[float](), list[float]()
    async with running(line):
        start = await until(lambda: line.good(healthy))
        await asyncio.sleep(SETTLED)
        line.bench.vanish()
        line.bench.come_back()
        await until(lambda: not line.good(healthy))
        reset = await until(lambda: line.good(healthy))
        await asyncio.sleep(SETTLED)
        since, reads, other = now(), len(line.reads(healthy)), 0.0
        for _ in range(returns):
            await asyncio.sleep(chance.uniform(5.0, 25.0))
            outcome = line.submit(healthy, healthy.tags[-1], chance.randrange(1000))
            index = chance.randrange(STATIONS - 1)
            line.stations[index].mute = False
            back = line.devices[index]
            seen.append(await until(lambda: line.good(back)))  # noqa: B023  (awaited here)
            await asyncio.sleep(PRESENT)
            line.stations[index].mute = True
            await until(lambda: not back.health.online)  # noqa: B023  (awaited here)
            writes.append(outcome.at - outcome.asked)
        kept = (len(line.reads(healthy)) - reads) * EVERY / (now() - since - other)
    limits = forecast("line", line.devices, line.wire)
    seen.sort()
    promised = getattr(limits, "seen_within", None)
    return [
        f"{start:.1f}",
        f"{reset:.1f}",
        f"{seen[len(seen) // 2]:.1f}",
        f"{seen[int(len(seen) * 0.99)]:.1f}",
        "-" if promised is None else f"{promised:.1f}",
        f"{kept:.3f}",
        f"{max(writes):.2f}",
        f"{limits.worst_write_silent:.2f}",
    ]


async def at_once(baudrate: int, turnaround: float, seed: int) -> list[str]:
    """Measures the return of all stations but one, which had replied before."""
    chance, line = random.Random(seed), silent_plant(baudrate, turnaround, seed, SELDOM)
    healthy, others, writes = line.devices[-1], line.devices[:-1], []
    async with running(line):
        for station in line.stations:
            station.mute = False
        await asyncio.sleep(SETTLED)
        for station in line.stations[:-1]:
            station.mute = True
        await until(lambda: not any(other.health.online for other in others))
        for _ in range(100):
            await asyncio.sleep(chance.uniform(0.5, 3.0))
            writes.append(line.submit(healthy, healthy.tags[-1], chance.randrange(1000)))
        await asyncio.sleep(10.0)
        for station in line.stations:
            station.mute = False
        half = await until(lambda: sum(map(line.good, others)) > len(others) // 2)
        rest = await until(lambda: all(map(line.good, others)))
    polls = sum(other.seconds(block.cost) for other in others for block in other.blocks)
    slowest = max(write.at - write.asked for write in writes)
    return [f"{half:.1f}", f"{half + rest:.1f}", f"{polls:.1f}", f"{slowest:.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--returns", type=int, default=100)
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    parser.add_argument("--at-once", action="store_true", help="all return at one moment")
    parser.add_argument("--once", action="store_true", help="print bare figures")
    chosen = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    if chosen.once:
        for baudrate in (19200, 57600) if chosen.at_once else (9600, 19200):
            for turnaround in (0.0, 0.03):
                if chosen.at_once:
                    figures = run_virtual(at_once(baudrate, turnaround, 1))
                else:
                    figures = run_virtual(measure(baudrate, turnaround, chosen.returns, 1))
                print(baudrate, 1000 * turnaround, *figures)
        return
    from benchmarks.checkouts import run_in

    trees = {"now": Path(__file__).parent.parent}
    if chosen.before is not None:
        trees = {"before": chosen.before.resolve(), **trees}
    one = "start | reset | seen, median | p99 | `check` | kept | write"
    title = "half | all | polls | write" if chosen.at_once else one
    print(f"| | baud | turnaround + ms | {title}")
    more = ["--at-once"] if chosen.at_once else []
    for name, tree in trees.items():
        for row in run_in(tree, __file__, ["--returns", str(chosen.returns), *more]):
            print(f"| {name} | {' | '.join(row)} |")


if __name__ == "__main__":
    main()
