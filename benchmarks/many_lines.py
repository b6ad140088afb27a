"""Many lines in one process, on virtual time: `python -m benchmarks.many_lines`.

It runs 64 lines of 32 stations of 50 tags, each line at its baud rate, for a simulated minute. Then
it keeps 200,000 tags in memory only. It repeats both at a tenth of the size: growth should be
linear. Memory is the growth of the process; processor time is per sample.
"""

import argparse
import asyncio
import gc
import logging
import os
import resource
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import structlog

from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.line.line import Line
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.vigor import Vigor
from gateway.simulator.port import open_simulator
from gateway.stations.vigor import VigorStation
from gateway.tags import Sample
from gateway.tags.mirror import Mirror
from gateway.transport import Port, Receiver
from tests.sim.plant import make_tag
from tests.sim.virtual import run_virtual

WIRE = WireTiming(115200, 10)
TAGS = 50
TAGS_IN_MEMORY = 3125  # for each line


class Watching:
    """A sample sink with a mirror, as in the gateway."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self.samples_seen = 0

    def samples(self, samples: Sequence[Sample]) -> None:
        self.samples_seen += len(samples)
        self._mirror.update(samples)

    def online(self, device: Device, online: bool) -> None:
        pass


def megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def devices(line: int, stations: int) -> list[Device]:
    found = []
    for station in range(1, stations + 1):
        name = f"line{line}-plc{station}"
        tags = tuple(make_tag(f"D{n}", every=5.0, device=name) for n in range(TAGS))
        driver = Vigor(station=station)
        settings = DeviceSettings(
            name=name, driver=driver, timing=driver.timing, turnaround=0.005, tags=tags
        )
        found.append(Device(settings, WIRE))
    return found


def opener(stations: Sequence[VigorStation]) -> Callable[[Receiver], Awaitable[Port]]:
    return lambda receiver: open_simulator(stations, WIRE, receiver)


def run(lines: int, stations: int, seconds: float) -> tuple[float, float, float, int]:
    """Megabytes, seconds to build, microseconds of CPU per sample, samples."""
    gc.collect()
    before, begun = megabytes(), time.process_time()
    plants = [devices(number, stations) for number in range(lines)]
    mirror = Mirror((tag for plant in plants for device in plant for tag in device.tags), 0)
    watching = Watching(mirror)
    built = time.process_time() - begun
    grown = megabytes() - before

    async def play() -> None:
        tasks = []
        for number, plant in enumerate(plants):
            served = [VigorStation(device.driver.station) for device in plant]
            engine = Engine(f"line{number}", plant, WIRE, number)
            line = Line(engine, opener(served), watching, wall=lambda: 0)
            tasks.append(asyncio.create_task(line.run()))
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    begun = time.process_time()
    run_virtual(play())
    spent = time.process_time() - begun
    return grown, built, spent / watching.samples_seen * 1e6, watching.samples_seen


def memory_of(count: int) -> tuple[float, float]:
    """Megabytes and seconds for so many tags in the mirror."""
    gc.collect()
    before, begun = megabytes(), time.process_time()
    tags = [make_tag(f"D{n % 8000}", device=f"plc{n // 8000}") for n in range(count)]
    mirror = Mirror(tags, 0)
    grown, spent = megabytes() - before, time.process_time() - begun
    assert mirror[tags[-1]].value is None
    return grown, spent


def in_child(function: str, *arguments: float) -> None:
    """Runs each row in a new process, so that no row uses the memory of another."""
    if (child := os.fork()) == 0:
        rows[function](*arguments)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"{function} {arguments} failed")


def show_run(lines: float, stations: float, seconds: float) -> None:
    grown, built, cpu, samples = run(int(lines), int(stations), seconds)
    count = int(lines) * int(stations) * TAGS
    print(
        f"{int(lines):5} lines x {int(stations)} stations, {count:7} tags: {grown:7.1f} MB, "
        f"planned in {built:5.2f} s, {cpu:5.1f} us of CPU per sample ({samples} samples)",
        flush=True,
    )


def show_memory(count: float) -> None:
    grown, spent = memory_of(int(count))
    print(f"{int(count):7} tags in memory: {grown:7.1f} MB, {spent:5.2f} s", flush=True)


rows: dict[str, Callable[..., None]] = {"run": show_run, "memory": show_memory}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of simulated time")
    parser.add_argument("--lines", type=int, default=64)
    options = parser.parse_args()
    seconds, lines = options.seconds, options.lines
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    in_child("run", max(1, lines // 10), 32, seconds)
    in_child("run", lines, 32, seconds)
    in_child("memory", TAGS_IN_MEMORY * lines // 10)
    in_child("memory", TAGS_IN_MEMORY * lines)


if __name__ == "__main__":
    main()
