"""Device servers that connect to one port: what 500 of them cost, and how soon they are back.

    python -m benchmarks.device_servers [--count 500] [--seconds 30] [--delay 2] [--nat]

The gateway is a process of its own. Each device server of this process registers, sends heartbeats
and answers one Modbus RTU read a second. Then all connections are reset at once, and each connects
again within a second. It prints processor time and memory of the gateway, and the seconds until
every device was polled again. `--delay`: seconds on the way to a device server and back. `--nat`:
at the end a NAT forgets all connections. Each device server connects again, the first connections
stay open, and a stranger connects, too.
"""

import argparse
import asyncio
import os
import random
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from gateway.protocols.checksums import crc16
from tests.e2e.processes import Program, free_port, started, write_config
from tests.zenoh_peer import free_endpoint

HEARTBEAT = 10.0  # seconds
READ = 8  # bytes of a request
TO_A_POLL = 3  # replies on a connection: to two requests of a resync, and to a poll


def reply(request: bytes) -> bytes:
    """Returns the reply of the slave: all its registers hold 7."""
    station, function = request[:2]
    frame = bytes([station, function | 0x80, 1])  # it has no other function
    if function == 3:
        data = bytes([0, 7]) * int.from_bytes(request[4:6])
        frame = bytes([station, function, len(data)]) + data
    return frame + crc16(frame)


class DeviceServer:
    """One of them, with a slave behind it."""

    def __init__(self, number: int, port: int, delay: float) -> None:
        self._delay, self._replies = delay, 0
        self._forgotten: list[asyncio.StreamWriter] = []  # nothing of them arrives any more
        self._registration = f"DTU-{number:04}".encode()
        self._port = port
        self._writer: asyncio.StreamWriter | None = None
        self.answered = asyncio.Event()

    async def run(self) -> None:
        while True:
            with suppress(OSError, asyncio.IncompleteReadError):
                await self._connect()
            await asyncio.sleep(random.random())

    async def _connect(self) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
        self._writer, self._replies = writer, 0
        writer.write(self._registration)
        beats = asyncio.create_task(self._beat(writer))
        try:
            while True:
                request = await reader.readexactly(READ)
                await asyncio.sleep(self._delay)
                if writer.is_closing():
                    return
                writer.write(reply(request))
                self._replies += 1
                if self._replies >= TO_A_POLL:
                    self.answered.set()
        finally:
            beats.cancel()
            if writer not in self._forgotten:
                writer.transport.abort()

    @staticmethod
    async def _beat(writer: asyncio.StreamWriter) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT)
            writer.write(b"ping")

    def reset(self) -> None:
        self.answered.clear()
        if self._writer is not None:
            self._writer.transport.abort()

    def forget(self) -> None:
        """Has a NAT forget the connection: it stays open, and nothing is sent on it."""
        self.answered.clear()
        if self._writer is not None:
            self._forgotten.append(self._writer)


def plant(folder: Path, port: int, count: int, delay: float) -> Path:
    def line(number: int) -> dict[str, Any]:
        tags = {"level": {"address": "holding:7", "every": "1s"}}
        device: dict[str, Any] = {"protocol": "modbus-rtu", "station": 1, "tags": tags}
        if delay:
            device["reply_timeout"] = f"{2 * delay + 1:g}s"
        return {
            "port": f"listen://127.0.0.1:{port}",
            "device_server": {"registration": f"DTU-{number:04}", "heartbeat": "ping"},
            "devices": {f"pump-{number}": device},
        }

    lines = {f"site-{number}": line(number) for number in range(count)}
    return write_config(folder / "plant.yaml", free_endpoint(), lines)


def used(gateway: Program) -> tuple[float, float]:
    """Returns the seconds of processor time and the MB of memory of the gateway."""
    stat = Path(f"/proc/{gateway.pid}/stat").read_text().rpartition(")")[2].split()
    pages = int(Path(f"/proc/{gateway.pid}/statm").read_text().split()[1])
    seconds = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
    return seconds, pages * os.sysconf("SC_PAGESIZE") / 1e6


async def forgotten(
    servers: Sequence[DeviceServer], tasks: Sequence[asyncio.Task[None]], port: int
) -> list[asyncio.Task[None]]:
    """Has a NAT forget all connections, and waits until every device was polled again."""
    begun = time.monotonic()
    for one in servers:
        one.forget()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    again = [asyncio.create_task(one.run()) for one in servers]
    _, stranger = await asyncio.open_connection("127.0.0.1", port)
    stranger.write(b"DTU-9999")
    await asyncio.gather(*(one.answered.wait() for one in servers))
    took = time.monotonic() - begun
    print(f"all connections forgotten: every device polled again within {took:.1f} s")
    return again


async def measured(
    gateway: Program, port: int, count: int, seconds: float, delay: float, *, nat: bool
) -> None:
    servers = [DeviceServer(number, port, delay) for number in range(count)]
    tasks = [asyncio.create_task(one.run()) for one in servers]
    begun = time.monotonic()
    await asyncio.gather(*(one.answered.wait() for one in servers))
    print(f"{count} device servers polled {time.monotonic() - begun:.1f} s after they began")
    before, began = used(gateway)[0], time.monotonic()
    await asyncio.sleep(seconds)
    after, memory = used(gateway)
    core = (after - before) / (time.monotonic() - began)
    print(f"one read a second of each: {core:.2f} of a core, {memory:.0f} MB")
    begun = time.monotonic()
    for one in servers:
        one.reset()
    await asyncio.gather(*(one.answered.wait() for one in servers))
    print(
        f"all connections reset: every device polled again within {time.monotonic() - begun:.1f} s"
    )
    if nat:
        tasks = await forgotten(servers, tasks, port)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--nat", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        port = free_port()
        with started(plant(Path(folder), port, asked.count, asked.delay)) as gateway:
            asyncio.run(
                measured(gateway, port, asked.count, asked.seconds, asked.delay, nat=asked.nat)
            )
            gateway.lines.clear()  # it prints them at the end


if __name__ == "__main__":
    main()
