"""A Modbus RTU slave on a TCP port, and the line or the program that polls it.

It shares no code with the gateway. Each register holds its own number. A request for a register
that it lacks, or for too many, gets the reply that the attack chose: an exception, or silence.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from gateway.config import load
from gateway.engine.device.device import Device
from gateway.line.line import Line
from gateway.plant.build import line_of
from gateway.tags import Quality, Sample
from tests.attacks.tcp_peer import peer
from tests.e2e.processes import Program, started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

PATIENCE = 300.0  # seconds; never waited for when all is well


def crc(data: bytes) -> bytes:
    left = 0xFFFF
    for byte in data:
        left ^= byte
        for _ in range(8):
            left = left >> 1 ^ (0xA001 if left & 1 else 0)
    return left.to_bytes(2, "little")


@dataclass
class Slave:
    """Any station. `exception`: its reply to a request that it cannot serve; None: silence."""

    has: Callable[[int], bool]
    exception: int | None = None
    longest: int = 125  # registers of one reply
    mute: bool = False  # every reply is lost
    delay: float = 0.0  # seconds before each reply
    requests: list[tuple[int, int]] = field(default_factory=list)  # first register, and number
    _heard: bytes = b""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(4096):
                self._heard += data
                while (size := self._size()) <= len(self._heard):
                    request, self._heard = self._heard[:size], self._heard[size:]
                    assert crc(request[:-2]) == request[-2:], request
                    replies = self._replies(request)
                    self._answer(writer, () if self.mute else replies)
        writer.close()

    def _size(self) -> int:
        return 9 + self._heard[6] if self._heard[1:2] == b"\x10" and self._heard[6:] else 8

    def _answer(self, writer: asyncio.StreamWriter, replies: Sequence[bytes]) -> None:
        loop = asyncio.get_running_loop()
        for number, reply in enumerate(replies, 1):
            if self.delay:
                loop.call_later(number * self.delay, writer.write, reply)
            else:
                writer.write(reply)

    def _replies(self, request: bytes) -> Sequence[bytes]:
        return (self._reply(request),)

    def _reply(self, request: bytes) -> bytes:
        function = request[1]
        first, count = int.from_bytes(request[2:4]), int.from_bytes(request[4:6])
        self.requests.append((first, count))
        numbers = range(first, first + count)
        if function == 3 and count <= self.longest and all(map(self.has, numbers)):
            data = b"".join(self._word(number).to_bytes(2) for number in numbers)
            reply = bytes((request[0], function, len(data))) + data
        elif self.exception is not None:
            reply = bytes((request[0], function | 0x80, self.exception))
        else:
            return b""
        return reply + crc(reply)

    def _word(self, number: int) -> int:
        return number


class Station(Protocol):
    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None: ...


@asynccontextmanager
async def program_on(
    station: Station,
    folder: Path,
    devices: Mapping[str, Any],
    line: Mapping[str, Any] | None = None,
    **sections: Any,
) -> AsyncIterator[tuple[Program, ZenohPeer]]:
    """Runs the program with these devices behind the station's port, and a client on Zenoh."""
    endpoint = free_endpoint()
    async with peer(lambda _, reader, writer: station.serve(reader, writer)) as number:
        hall = {"port": f"tcp://127.0.0.1:{number}", "baudrate": 115200, "devices": devices}
        lines = {"hall": {**hall, **(line or {})}}
        file = write_config(folder / "config.yaml", endpoint, lines, **sections)
        with await asyncio.to_thread(started, file) as program:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                yield program, client


@dataclass
class Watch:
    """The sink of the line. `good` and `wrong`: register numbers, by their last sample."""

    last: dict[int, Sample] = field(default_factory=dict)
    wrong: list[Sample] = field(default_factory=list)
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            number = sample.tag.address.number
            self.last[number] = sample
            if sample.quality is Quality.GOOD and sample.value != number:
                self.wrong.append(sample)
        self.news.set()

    def online(self, device: Device, online: bool) -> None: ...

    @property
    def good(self) -> set[int]:
        return {n for n, sample in self.last.items() if sample.quality is Quality.GOOD}

    async def until(self, happened: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened():
                self.news.clear()
                await self.news.wait()


@asynccontextmanager
async def polled(
    slave: Slave,
    folder: Path,
    numbers: Iterable[int] | Mapping[int, Any],
    *,
    echo: bool | None = None,
    close_after: str | None = None,
    **settings: Any,
) -> AsyncIterator[tuple[Line, Watch]]:
    """Runs a line that polls these registers of the slave. `numbers`: also with settings."""
    server = await asyncio.start_server(slave.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    more = numbers if isinstance(numbers, Mapping) else {n: {} for n in numbers}
    tags = {f"r{n}": {"address": f"holding:{n}", "type": "uint16", **s} for n, s in more.items()}
    device = {
        "protocol": "modbus-rtu",
        "station": 1,
        "reply_timeout": "100ms",
        "late_guard": "50ms",
        **settings,
        "tags": tags,
    }
    line = {"port": f"tcp://127.0.0.1:{port}", "baudrate": 115200, "devices": {"slave": device}}
    line |= {} if echo is None else {"echo": echo}
    line |= {} if close_after is None else {"close_after": close_after}
    file = write_config(folder / "config.yaml", "tcp/127.0.0.1:0", {"hall": line})
    [config] = load(file).lines
    watch = Watch()
    served = line_of(config, config.devices, watch)
    task = asyncio.create_task(served.run())
    try:
        yield served, watch
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        server.close()
    assert watch.wrong == []
