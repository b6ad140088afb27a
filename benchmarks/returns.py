"""Silent stations on one line: how soon they are seen again, and the cost for the others.

`python -m benchmarks.returns` runs 32 Vigor stations on virtual time, of which one is alive (the
last in the file). Others come back at random times, one after the other. It prints the time until
the healthy station is read after the start and after a reset of the port, the time until a
returned station is read, the share of the healthy station's polls that were done, and the longest
write to it. Beside them are the limits that `check` prints. `--before` names a checkout of another
version: both are then measured in turn.
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

STATIONS, EVERY, SETTLED = 32, 1.0, 120.0
PRESENT = 30.0  # seconds for which a returned station stays


async def until(true: Callable[[], bool], most: float = 600.0) -> float:
    """Returns the seconds until it is true."""
    begun = now()
    while not true() and now() - begun < most:
        await asyncio.sleep(0.02)
    return now() - begun


def silent_plant(baudrate: int, turnaround: float, seed: int) -> Plant:
    wire = WireTiming(baudrate, 10)
    devices = []
    for station in range(1, STATIONS + 1):
        tags = words(0, 20, every=EVERY, device=f"plc{station}")
        tags.append(make_tag("D500", every=EVERY, device=f"plc{station}", write=WriteRule()))
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--returns", type=int, default=100)
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    parser.add_argument("--once", action="store_true", help="print bare figures")
    chosen = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    if chosen.once:
        for baudrate in (9600, 19200):
            for turnaround in (0.0, 0.03):
                figures = run_virtual(measure(baudrate, turnaround, chosen.returns, 1))
                print(baudrate, 1000 * turnaround, *figures)
        return
    from benchmarks.checkouts import run_in

    trees = {"now": Path(__file__).parent.parent}
    if chosen.before is not None:
        trees = {"before": chosen.before.resolve(), **trees}
    print(
        "| | baud | turnaround + ms | start | reset | seen, median | p99 | `check` | kept | write"
    )
    for name, tree in trees.items():
        for row in run_in(tree, __file__, ["--returns", str(chosen.returns)]):
            print(f"| {name} | {' | '.join(row)} |")


if __name__ == "__main__":
    main()
