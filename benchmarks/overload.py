"""Reads per second of processor time on overloaded lines: `python -m benchmarks.overload`.

Devices on one Modbus TCP line, of 30 blocks each, all asked far too often. The device answers at
once, in this process, so the figures include its small part. `--before` names a checkout of
another version: both are then measured in turn.
"""

import argparse
import asyncio
import logging
import struct
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import structlog

from benchmarks.words import words
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.line.line import Line
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.modbus import ModbusTcp
from gateway.tags import Sample
from gateway.transport import Port, Receiver

BLOCKS, SIZE = 30, 2
COUNTS = (1, 10, 50, 100)
WIRE = WireTiming(NETWORK_BAUD, 10)


class Answering:
    """A port whose device replies with zeros at once."""

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver

    def write(self, data: bytes) -> None:
        number, _, _, unit, function, _, count = struct.unpack(">HHHBBHH", data)
        reply = struct.pack(">HHHBBB", number, 0, 3 + 2 * count, unit, function, 2 * count)
        loop = asyncio.get_running_loop()
        loop.call_soon(self._receiver.received, reply + bytes(2 * count))

    async def close(self) -> None:
        pass


class Counting:
    """Counts the reads; sets `begun` after so many and `done` after more."""

    def __init__(self, before: int, reads: int) -> None:
        self._seen, self._before, self._last = 0, before, before + reads
        self.begun, self.done = asyncio.Event(), asyncio.Event()

    def samples(self, samples: Sequence[Sample]) -> None:
        self._seen += 1
        if self._seen == self._before:
            self.begun.set()
        elif self._seen == self._last:
            self.done.set()

    def online(self, device: Device, online: bool) -> None:
        pass


def devices(count: int, window: int) -> list[Device]:
    found = []
    for station in range(1, count + 1):
        driver = ModbusTcp(station=station, window=window)
        starts = range(0, BLOCKS * 1000, 1000)
        tags = words("holding", (n + i for n in starts for i in range(SIZE)), 1e-6, kind="uint16")
        timing = replace(driver.timing, silence=0.0)
        settings = DeviceSettings(
            name=f"plc{station}", driver=driver, timing=timing, turnaround=0.5, tags=tags
        )
        found.append(Device(settings, WIRE))
    return found


async def measure(count: int, window: int, reads: int) -> float:
    """Returns the reads per second of processor time, once every block was read."""
    sink = Counting(count * BLOCKS, reads)

    async def port(receiver: Receiver) -> Port:
        return Answering(receiver)

    line = Line(Engine("bench", devices(count, window), WIRE), port, sink)
    task = asyncio.create_task(line.run())
    await sink.begun.wait()
    begun = time.process_time()
    await sink.done.wait()
    spent = time.process_time() - begun
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return reads / spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reads", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--window", type=int, default=1)
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    parser.add_argument("--once", action="store_true", help="print bare figures of one round")
    chosen = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    if chosen.once:
        for count in COUNTS:
            print(asyncio.run(measure(count, chosen.window, chosen.reads)))
        return
    arguments = ["--reads", str(chosen.reads), "--window", str(chosen.window)]
    from benchmarks.checkouts import run_in

    trees = {"now": Path(__file__).parent.parent}
    if chosen.before is not None:
        trees = {"before": chosen.before.resolve(), **trees}
    best = {name: [0.0] * len(COUNTS) for name in trees}
    for _ in range(chosen.rounds):
        for name, tree in trees.items():
            found = [float(word) for [word] in run_in(tree, __file__, arguments)]
            best[name] = [max(pair) for pair in zip(best[name], found, strict=True)]
    print(f"devices of {BLOCKS} blocks, window {chosen.window}: reads per second of CPU")
    for name, figures in best.items():
        row = "  ".join(f"{n:3}: {each:6.0f}" for n, each in zip(COUNTS, figures, strict=True))
        print(f"  {name:7} {row}")


if __name__ == "__main__":
    main()
