"""Many serial adapters at one gateway, as ptys: `python -m benchmarks.adapters [--count 64]`.

Each pty is a line at 19200 baud with one station and two blocks a second. A process of this program
holds each reply for the time of its characters and for that of the adapter's timer: 16 ms as many
are delivered, 1 ms with low latency, 0. It prints processor time of the gateway, polls a second,
the time of one poll, and by how much the time between two polls of a block differs from the
interval. USB itself, its hub and its drivers are not in it.
"""

import argparse
import asyncio
import os
import tempfile
import time
import tty
from functools import partial
from pathlib import Path

from benchmarks.device_servers import reply, used
from tests.e2e.processes import Program, started, write_config
from tests.zenoh_peer import free_endpoint

BAUD = 19200
CHARACTER = 10 / BAUD  # seconds
TURNAROUND = 0.005  # seconds
TIMERS = (0.016, 0.001, 0.0)  # seconds
BLOCKS = (0, 1000)
EVERY = 1.0  # seconds


class Adapter:
    """A pty with a station behind it."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self.timer = 0.0
        self.took: list[float] = []  # seconds from a request to the end of its reply
        self.differs: list[float] = []  # seconds by which a poll is not an interval after the last
        self._asked_at = dict[bool, float]()
        asyncio.get_running_loop().add_reader(self._master, self._asked)

    def _asked(self) -> None:
        request, now = os.read(self._master, 4096), time.monotonic()
        if len(request) != 8:
            return
        block = int.from_bytes(request[2:4]) > BLOCKS[1] // 2  # a read may begin a little before it
        if block in self._asked_at:
            self.differs.append(abs(now - self._asked_at[block] - EVERY))
        self._asked_at[block] = now
        answer = reply(request)
        seconds = (len(request) + len(answer)) * CHARACTER + TURNAROUND + self.timer
        asyncio.get_running_loop().call_later(seconds, partial(self._answer, answer, now))

    def _answer(self, answer: bytes, asked: float) -> None:
        os.write(self._master, answer)
        self.took.append(time.monotonic() - asked)

    def restart(self, timer: float) -> None:
        self.timer, self.took, self.differs = timer, [], []
        self._asked_at.clear()


def plant(folder: Path, adapters: list[Adapter]) -> Path:
    tags = {f"t{n}": {"address": f"holding:{n}", "every": f"{EVERY:g}s"} for n in BLOCKS}
    press = {"protocol": "modbus-rtu", "station": 1, "tags": tags}
    lines = {
        f"line-{n}": {
            "port": one.path,
            "baudrate": BAUD,
            "format": "8N1",
            "devices": {f"press-{n}": press},
        }
        for n, one in enumerate(adapters)
    }
    return write_config(folder / "plant.yaml", free_endpoint(), lines)


def at(share: float, found: list[float]) -> float:
    """Returns a percentile in milliseconds."""
    return 1000 * sorted(found)[int(share * (len(found) - 1))] if found else 0.0


async def measured(gateway: Program, adapters: list[Adapter], seconds: float) -> None:
    async with asyncio.timeout(120):
        while not all(len(one.took) > 4 for one in adapters):
            await asyncio.sleep(0.1)
    for timer in TIMERS:
        for one in adapters:
            one.restart(timer)
        before, begun = used(gateway)[0], time.monotonic()
        await asyncio.sleep(seconds)
        after, memory = used(gateway)
        elapsed = time.monotonic() - begun
        took = [each for one in adapters for each in one.took]
        differs = [each for one in adapters for each in one.differs]
        print(
            f"{len(adapters)} adapters, timer {1000 * timer:2.0f} ms: "
            f"{(after - before) / elapsed:.3f} of a core, {memory:.0f} MB, "
            f"{len(took) / elapsed:.1f} polls/s, {at(0.5, took):.0f} ms each "
            f"(p99 {at(0.99, took):.0f}), differ by {at(0.5, differs):.0f} ms "
            f"(p99 {at(0.99, differs):.0f})",
            flush=True,
        )
    gateway.lines.clear()


async def run(count: int, seconds: float) -> None:
    adapters = [Adapter() for _ in range(count)]
    with (
        tempfile.TemporaryDirectory() as folder,
        started(plant(Path(folder), adapters)) as gateway,
    ):
        await measured(gateway, adapters, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    asyncio.run(run(asked.count, asked.seconds))


if __name__ == "__main__":
    main()
