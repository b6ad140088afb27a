"""Other makers' programs at the doors of a polled line: `python -m benchmarks.doors`.

A gateway polls 300 registers of libmodbus' slave behind a wire of 19200 baud. Programs use its
doors: mbpoll, libmodbus' master, npm's modbus-serial and pymodbus, alone and two at once, and two
that ask for 125 registers without a pause. The wire itself counts the polls. It prints how many
were lost against the same time without programs, and the longest time between two reads of one
block, beside the worst age that `check` prints. It also prints how long a poll took, from its
request to the end of its reply, and the share of the time that programs had: on a busy computer
both take longer than planned, and the wire may be full.
"""

import argparse
import asyncio
import itertools
import json
import os
import re
import select
import struct
import subprocess
import tempfile
import threading
import time
import tty
from collections import defaultdict
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe, Process
from multiprocessing.connection import Connection
from pathlib import Path

from pymodbus import FramerType
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusIOException

from tests.e2e.processes import free_port, plc_gateway, started, write_config
from tests.interop.peers import HERE, finished, running
from tests.zenoh_peer import free_endpoint

BAUD, BITS = 19200, 10
TURNAROUND = 0.005  # seconds
BLOCKS, SIZE = 10, 30
FIRST, APART = 2000, 200  # polled registers; programs ask for others


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request and its reply on the wire. Times in seconds. `block`: None for a program's."""

    block: int | None
    asked: float
    ended: float


class Wire:
    """Two ptys with a wire between them, in a process of its own."""

    def __init__(self) -> None:
        self._ends = [os.openpty() for _ in range(2)]
        for _, slave in self._ends:
            tty.setraw(slave)
        self.gateway, self.plc = (os.ttyname(slave) for _, slave in self._ends)
        self._done, theirs = Pipe()
        self._process = Process(target=self._carry, args=(theirs,), daemon=True)
        self._process.start()
        self._found = list[Exchange]()
        threading.Thread(target=self._note, daemon=True).start()

    def _note(self) -> None:
        """Takes the reports: the wire waits for none."""
        with suppress(EOFError):
            while True:
                self._found.append(Exchange(*self._done.recv()))

    def _carry(self, done: Connection) -> None:
        """Passes bytes on when their last character has passed, and reports each exchange."""
        ours, theirs = (master for master, _ in self._ends)
        block, asked = None, 0.0
        while True:
            for end in select.select([ours, theirs], [], [])[0]:
                began, data = time.monotonic(), os.read(end, 4096)
                if end == ours:
                    block, asked = _block(data), began
                pause = len(data) * BITS / BAUD + (TURNAROUND if end == theirs else 0.0)
                time.sleep(max(0.0, began + pause - time.monotonic()))
                os.write(theirs if end == ours else ours, data)
                if end == theirs:
                    done.send((block, asked, time.monotonic()))

    def exchanges(self) -> list[Exchange]:
        """Returns the exchanges since the last call."""
        found, self._found = self._found, []
        return found

    def end(self) -> None:
        self._process.kill()
        self._process.join()


def _block(request: bytes) -> int | None:
    """Returns the block that a request polls, which begins a register before it at times."""
    if len(request) != 8 or request[1] != 3:
        return None
    first, count = struct.unpack_from(">HH", request, 2)
    return (first - FIRST + 10) // APART if first > FIRST - 10 and count >= SIZE else None


def plant(folder: Path, port: str, doors: Sequence[int]) -> Path:
    tags = {
        f"t{n}": {"address": f"holding:{FIRST + n // SIZE * APART + n % SIZE}"}
        for n in range(BLOCKS * SIZE)
    }
    share = {
        protocol: {
            "line": "hall",
            "listen": f"127.0.0.1:{number}",
            "protocol": protocol,
            "reply_within": "5s",
            "writes": {"press": ["holding:100..holding:163", "coil:16..coil:36"]},
        }
        for protocol, number in zip(("modbus-tcp", "modbus-rtu"), doors, strict=True)
    }
    press = {"protocol": "modbus-rtu", "station": 1, "tags": tags, "defaults": {"every": "1s"}}
    hall = {"port": port, "baudrate": BAUD, "format": "8N1", "devices": {"press": press}}
    return write_config(
        folder / "hall.yaml", free_endpoint(), {"hall": hall}, share={"doors": share}
    )


class Programs:
    """The programs, by name: each works until it is cancelled, and counts its requests.

    A request without a reply counts as such; a wrong value ends the benchmark.
    """

    def __init__(self, libmodbus: Path, tcp: int, rtu: int) -> None:
        self._master, self._tcp, self._rtu = libmodbus, str(tcp), rtu
        self.requests = self.unanswered = 0

    async def _run(self, requests: int, *command: str | Path) -> str:
        """Returns the output of a program; empty if it got no reply."""
        try:
            out = await finished(*command)
        except AssertionError as error:
            if not re.search("[Tt]imed out|failed to respond|Timed Out", str(error)):
                raise
            self.unanswered += 1
            return ""
        self.requests += requests
        return out

    async def mbpoll(self) -> None:
        ask = ("mbpoll", "-m", "tcp", "-p", self._tcp, "-0", "-1", "-a", "1", "-o", "5")
        while True:
            out = await self._run(1, *ask, "-t", "4", "-r", "500", "-c", "20", "127.0.0.1")
            assert not out or "[519]: \t519" in out, out

    async def libmodbus(self) -> None:
        while True:
            await self._run(20, self._master, "tcp", self._tcp, "1", "20")

    async def modbus_serial(self) -> None:
        program = HERE / "modbus_serial_client.js"
        while True:
            out = await self._run(7, "node", program, self._tcp, "1", "tcp")
            assert not out or json.loads(out)["words"] == [1, 2, 65535, 0xBEEF], out

    async def pymodbus(self, first: int = 700, count: int = 50) -> None:
        client = AsyncModbusTcpClient(
            "127.0.0.1", port=self._rtu, framer=FramerType.RTU, timeout=10
        )
        assert await client.connect()
        try:
            while True:
                try:
                    found = await client.read_holding_registers(first, count=count, device_id=1)
                except ModbusIOException:
                    self.unanswered += 1
                    continue
                assert found.registers == [*range(first, first + count)], found
                self.requests += 1
        finally:
            client.close()

    async def flood(self) -> None:
        await asyncio.gather(self.pymodbus(200, 125), self.pymodbus(400, 125))

    async def both(self) -> None:
        await asyncio.gather(self.libmodbus(), self.pymodbus())

    async def none(self) -> None:
        await asyncio.Event().wait()


def built(folder: Path) -> tuple[Path, Path]:
    """Returns libmodbus' slave and master."""
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], check=True, stdout=subprocess.PIPE
    )
    for name in ("modbus_slave", "modbus_master"):
        command = ["gcc", "-O2", "-o", str(folder / name), str(HERE / f"{name}.c")]
        subprocess.run([*command, *flags.stdout.decode().split()], check=True)
    return folder / "modbus_slave", folder / "modbus_master"


@dataclass(frozen=True, slots=True)
class Use:
    """The use of the wire in a time. `longest`: seconds between two polls of a block."""

    polls: int
    longest: float
    poll: float  # seconds of one poll, in the mean
    guests: float  # share of the time in exchanges of programs


async def counted(wire: Wire, work: Callable[[], Awaitable[None]], seconds: float) -> Use:
    task = asyncio.ensure_future(work())
    await asyncio.sleep(min(2.0, seconds))  # the program has begun
    wire.exchanges()
    done, _ = await asyncio.wait([task], timeout=seconds)
    exchanges = wire.exchanges()
    for ended in done:
        ended.result()
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
    times, took, guests = defaultdict[int, list[float]](list), 0.0, 0.0
    for one in exchanges:
        if one.block is None:
            guests += one.ended - one.asked
        else:
            times[one.block].append(one.asked)
            took += one.ended - one.asked
    gaps = (b - a for row in times.values() for a, b in itertools.pairwise(row))
    polls = sum(map(len, times.values()))
    return Use(polls, max(gaps, default=0.0), took / max(1, polls), guests / seconds)


async def measured(names: Sequence[str], rounds: int, seconds: float, folder: Path) -> None:
    slave, master = built(folder)
    wire, ports = Wire(), (free_port(), free_port())
    file = plant(folder, wire.gateway, ports)
    print(plc_gateway("check", file).out)
    async with running(slave, "rtu", wire.plc, "1", ready=b"ready"):
        with started(file) as gateway:
            gateway.says("device online", "press")
            programs, alone = Programs(master, *ports), 1
            await asyncio.sleep(min(5.0, seconds))
            for name in ("none", *names) * rounds:
                programs.requests = programs.unanswered = 0
                use = await counted(wire, getattr(programs, name), seconds)
                if name == "none":
                    alone = use.polls or 1
                rate, lost = programs.requests / seconds, 1 - use.polls / alone
                print(
                    f"{name:<13} {rate:5.1f} requests/s, {programs.unanswered} unanswered, "
                    f"{use.guests:5.1%} of the time; polls {use.polls:5}, {lost:6.1%} lost, "
                    f"{1000 * use.poll:.0f} ms each, {use.longest:.2f} s between two of a block",
                    flush=True,
                )
            gateway.lines.clear()
    wire.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=1, help="with programs and without, in turn")
    every = ["mbpoll", "libmodbus", "modbus_serial", "pymodbus", "both", "flood"]
    parser.add_argument("--programs", nargs="+", default=every, choices=every)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(measured(asked.programs, asked.rounds, asked.seconds, Path(folder)))


if __name__ == "__main__":
    main()
