"""Files entered and moves between files for one poll and one write: `python -m benchmarks.moves`.

A line with a real TCP port asks a simulated Vigor station in another process. A profile hook
records the calls into gateway/ from one `Engine.next` to the next, without stations/ and
simulator/. A move is a call in another file than the call before. A coroutine that goes on counts
as called once more. Most polls, and most writes, have as many. `--calls` prints one of them.
"""

import argparse
import asyncio
import itertools
import logging
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import structlog

import gateway
from benchmarks.transactions import VIGOR_STATION, process, tcp_opener
from benchmarks.words import words
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Job, Poll
from gateway.engine.jobs.requests import Write
from gateway.line.line import Line
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.vigor import Vigor
from gateway.tags import Sample, Tag
from gateway.tags.mirror import Mirror

ROOT = f"{Path(gateway.__file__).parent}/"
LEFT_OUT = ("stations/", "simulator/")
WIRE = WireTiming(NETWORK_BAUD, 10)


class Call(NamedTuple):
    """One call of a function of the gateway."""

    file: str
    function: str


class Sink:
    """Updates a mirror, as the gateway does."""

    def __init__(self, tags: Sequence[Tag]) -> None:
        self._mirror = Mirror(tags, 0)

    def samples(self, samples: Sequence[Sample]) -> None:
        self._mirror.update(samples)

    def online(self, device: Device, online: bool) -> None:
        pass


class Recorded(Engine):
    """An engine that cuts the recorded calls at every `next`."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__("bench", devices, WIRE)
        self.calls: list[Call] = []
        self.cycles: list[tuple[Job, list[Call]]] = []
        self._job: Job | None = None

    def next(self, now: float) -> Job:
        if self._job is not None:
            self.cycles.append((self._job, self.calls))
        self.calls = []
        self._job = super().next(now)
        return self._job

    def profile(self, frame: FrameType, event: str, _: Any) -> None:
        """The hook for `sys.setprofile`."""
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(ROOT):
            file = file.removeprefix(ROOT)
            if not file.startswith(LEFT_OUT):
                self.calls.append(Call(file, frame.f_code.co_name))


async def record(port: int) -> Recorded:
    """One second of polls, then a few writes."""
    driver = Vigor(station=1)
    tags = words("D", range(100, 104), 0.05, kind="uint16", writable=[100])
    settings = DeviceSettings(name="plc", driver=driver, timing=driver.timing, tags=tags)
    engine = Recorded([Device(settings, WIRE)])
    line = Line(engine, tcp_opener(port), Sink(tags))
    task = asyncio.create_task(line.run())
    await asyncio.sleep(1.0)
    sys.setprofile(engine.profile)
    await asyncio.sleep(0.5)
    for number in range(5):
        await line.write(engine.devices[0], tags[0], [number])
        await asyncio.sleep(0.527)  # between two polls, and without a resync for the write before
    sys.setprofile(None)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return engine


def moves(calls: Sequence[Call]) -> int:
    files = [call.file for call in calls]
    return sum(before != after for before, after in itertools.pairwise(files))


def usual() -> dict[str, list[Call]]:
    """The calls of a poll and of a write, as most of them make them."""
    with process(sys.executable, "-c", VIGOR_STATION, "tcp") as where:
        engine = asyncio.run(record(int(where.rpartition(":")[2])))
    found: dict[str, list[Call]] = {}
    for name, kind in (("poll", Poll), ("write", Write)):
        # The first cycle of a kind may begin before the hook was set.
        cycles = [calls for job, calls in engine.cycles if isinstance(job, kind) and calls]
        most = statistics.mode(map(moves, cycles[1:]))
        found[name] = next(calls for calls in cycles[1:] if moves(calls) == most)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", action="store_true", help="print every call")
    show = parser.parse_args().calls
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    for name, calls in usual().items():
        entered = len({call.file for call in calls})
        print(f"{name:6} {entered:3} files entered, {moves(calls):3} moves between files")
        if show:
            for call in calls:
                print(f"    {call.file:32} {call.function}")


if __name__ == "__main__":
    main()
