"""A hostile TCP peer with one handler for each connection, and real lines that connect to it."""

import asyncio
import json
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gateway.config import load
from gateway.engine.device.device import Device
from gateway.line.line import Line
from gateway.plant.build import line_of
from gateway.tags import Quality, Sample

PATIENCE = 300.0  # seconds; never waited for when all is well
Handler = Callable[[int, asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def peer(handle: Handler) -> AsyncIterator[int]:
    """A server on a free port; `handle` gets the number of the connection, from 0."""
    tasks: set[asyncio.Task[None]] = set()
    count = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal count
        number, count = count, count + 1
        task = asyncio.current_task()
        assert task is not None
        tasks.add(task)
        try:
            with suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
                await handle(number, reader, writer)
        finally:
            tasks.discard(task)
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in list(tasks):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def modbus_tcp(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Replies to every read until the connection ends: each register holds its own number."""
    while True:
        writer.write(tcp_reply(await reader.readexactly(12)))


def tcp_reply(request: bytes) -> bytes:
    first, count = int.from_bytes(request[8:10], "big"), int.from_bytes(request[10:12], "big")
    words = b"".join((n & 0xFFFF).to_bytes(2, "big") for n in range(first, first + count))
    body = request[6:8] + bytes([len(words)]) + words
    return request[:4] + len(body).to_bytes(2, "big") + body


@dataclass
class Readings:
    """A `SampleSink` that counts good samples and wakes those that wait for a condition."""

    good: int = 0
    bad: list[Sample] = field(default_factory=list)
    last: dict[str, Sample] = field(default_factory=dict)
    _news: asyncio.Event = field(default_factory=asyncio.Event)

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self.last[sample.tag.name] = sample
            if sample.quality is Quality.GOOD:
                self.good += 1
            else:
                self.bad.append(sample)
        self._news.set()

    def online(self, device: Device, online: bool) -> None:
        self._news.set()

    async def until(self, happened: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened():
                self._news.clear()
                await self._news.wait()

    async def more_good(self, count: int) -> None:
        wanted = self.good + count
        await self.until(lambda: self.good >= wanted)


def made_line(
    number: int, tags: Sequence[str], sink: Readings, stations: int = 1, **device: Any
) -> Line:
    """A Modbus TCP line to this port; `device`: its settings, and those of the line in `line`."""
    settings = {"protocol": "modbus-tcp", "reply_timeout": "200ms", **device}
    line = {"port": f"tcp://127.0.0.1:{number}", **settings.pop("line", {})}
    named = {f"t{n}": {"address": text, "type": "uint16"} for n, text in enumerate(tags)}
    every = settings.pop("every", "50ms")
    devices = {f"plc{n}": {**settings, "station": n, "tags": named} for n in range(1, stations + 1)}
    document = {
        "gateway": {"name": "demo"},
        "defaults": {"every": every},
        "lines": {"net": {**line, "devices": devices}},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "line.yaml")
        file.write_text(json.dumps(document))
        [config] = load(file).lines
    return line_of(config, config.devices, sink)


@asynccontextmanager
async def running(*lines: Line) -> AsyncIterator[None]:
    async with AsyncExitStack() as stack:
        for line in lines:
            task = asyncio.create_task(line.run())
            stack.push_async_callback(_ended, task)
        yield


async def _ended(task: "asyncio.Task[None]") -> None:
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
