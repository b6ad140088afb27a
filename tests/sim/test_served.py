"""A served line beside a master that is late, collides and repeats, and beside other stations."""

import asyncio
import random
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from gateway.config import built
from gateway.parts.serving.served_line import ServedLine
from gateway.protocols.checksums import crc16
from gateway.stations.served.station import ServedStation
from gateway.tags import Quality, Sample
from gateway.transport import Port, Receiver

CHARACTER = 11 / 19200
REQUESTS = 400


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc16(body)


def rtu_write(value: int) -> bytes:
    return rtu(f"01 10 0004 0002 04 {value & 0xFFFF:04x} {value >> 16:04x}")


def vigor(text: str, begin: int = 2) -> bytes:
    body = f"{text}\x03".encode()
    return bytes([begin]) + body + f"{sum(body) & 0xFF:02X}".encode()


def vigor_write(value: int) -> bytes:
    return vigor(f"0161{0x1C00 + 2 * 4:04X}04{value.to_bytes(4, 'little').hex().upper()}")


def link(text: str) -> bytes:
    return f"\x05{text}{sum(text.encode()) & 0xFF:02X}\r\n".encode()


def link_write(value: int) -> bytes:
    return link(f"01FFWW0D000402{value & 0xFFFF:04X}{value >> 16:04X}")


@dataclass(frozen=True)
class Language:
    """The frames of a master that writes to station 1, and of another station."""

    settings: dict[str, object]
    address: str
    accept: str
    write: Callable[[int], bytes]
    reply: bytes  # to each write
    is_error: Callable[[bytes], bool]  # a reply to a damaged request, in place of silence
    other_request: bytes
    other_reply: Callable[[bytes], bytes]  # with these bytes inside
    least: float  # seconds from a request to the reply


MODBUS = Language(
    settings={"protocol": "modbus-rtu"},
    address="holding:4",
    accept="holding:4..holding:9",
    write=rtu_write,
    reply=rtu("01 10 0004 0002"),
    is_error=lambda reply: False,
    other_request=rtu("03 03 0000 0008"),
    other_reply=lambda data: rtu(f"03 03 {len(data):02x} {data.hex()}"),
    least=0.00175,
)
VIGOR = Language(
    settings={"protocol": "vigor"},
    address="D4",
    accept="D4..D9",
    write=vigor_write,
    reply=vigor("016100", 6),
    is_error=lambda reply: reply[:3] == b"\x0601" and reply[5:7] in (b"10", b"11", b"12"),
    other_request=vigor("03511C0010"),
    other_reply=lambda data: vigor(f"035100{data.hex().upper()}", 6),
    least=0.0,
)
LINK = Language(
    settings={"protocol": "computer-link", "frame_format": 4, "sum_check": True},
    address="D0004",
    accept="D0004..D0009",
    write=link_write,
    reply=b"\x0601FF\r\n",
    is_error=lambda reply: reply[:5] == b"\x1501FF",
    other_request=link("03FFWR0D000009"),
    other_reply=lambda data: f"\x0203FF{data.hex().upper()}\x0300\r\n".encode(),
    least=0.0,
)


class Wire:
    """Both ends of the line, and all that happened on it."""

    def __init__(self) -> None:
        self.receiver: Receiver | None = None
        self.replies: list[tuple[float, bytes]] = []  # with the time when they begin
        self.asked: list[float] = []  # ends of sound requests to station 1
        self.given: list[Sample] = []

    async def open(self, receiver: Receiver) -> Port:
        self.receiver = receiver
        return self

    def write(self, data: bytes) -> None:
        self.replies.append((asyncio.get_running_loop().time(), data))

    async def close(self) -> None: ...

    def samples(self, samples: Sequence[Sample]) -> None:
        self.given += samples

    def online(self, device: ServedStation, online: bool) -> None: ...

    async def send(self, data: bytes, draw: random.Random) -> None:
        """Sends with the time of the characters, in the pieces of an adapter."""
        assert self.receiver is not None
        at = 0
        while at < len(data):
            piece = data[at : at + draw.choice((1, 4, 16, 64))]
            await asyncio.sleep(len(piece) * CHARACTER)
            self.receiver.received(piece)
            at += len(piece)


class Master:
    """Writes another value each time, and makes mistakes."""

    def __init__(self, wire: Wire, language: Language, draw: random.Random) -> None:
        self._wire = wire
        self._language = language
        self._draw = draw
        self.sent = Counter[int]()  # sound writes, by value
        self._value = 0

    async def work(self) -> None:
        for _ in range(REQUESTS):
            act = self._draw.choice((self._write, self._write, self._damaged, self._others))
            await act()
            await asyncio.sleep(self._draw.choice((0.004, 0.02, 0.3)))

    def _request(self) -> bytes:
        self._value += 1
        return self._language.write(self._value)

    async def _write(self) -> None:
        request = self._request()
        for _ in range(self._draw.choice((1, 1, 1, 2, 3))):  # it repeats, and may not wait
            await self._wire.send(request, self._draw)
            self._wire.asked.append(asyncio.get_running_loop().time())
            self.sent[self._value] += 1
            await asyncio.sleep(self._draw.choice((0.0, 0.001, 0.05, 0.1)))

    async def _damaged(self) -> None:
        request = bytearray(self._request())
        if self._draw.random() < 0.5:
            del request[self._draw.randrange(2, len(request)) :]
        else:
            request[self._draw.randrange(len(request))] ^= 1 << self._draw.randrange(8)
        await self._wire.send(bytes(request), self._draw)
        await asyncio.sleep(0.1)  # its time-out

    async def _others(self) -> None:
        """Another station replies with the bytes of a write to station 1."""
        data = self._request()
        await self._wire.send(self._language.other_request, self._draw)
        await asyncio.sleep(self._draw.choice((0.002, 0.01)))
        await self._wire.send(self._language.other_reply(data), self._draw)


@pytest.mark.parametrize("language", [MODBUS, VIGOR, LINK])
@pytest.mark.parametrize("seed", range(2))
def test_an_acknowledged_write_is_published_exactly_once(
    seed: int, language: Language, run_virtual: Callable[[Coroutine[Any, Any, Any]], Any]
) -> None:
    wire, draw = Wire(), random.Random(seed)
    tags = {"order": {"address": language.address, "type": "uint32"}}
    plc = {**language.settings, "station": 1, "accept": [language.accept], "tags": tags}
    one = {"port": "/dev/ttyS9", "serve": True, "baudrate": 19200, "devices": {"plc": plc}}

    async def story() -> tuple[Master, ServedLine]:
        [config] = built({"lines": {"panel": one}}).lines
        line = ServedLine(config, wire, lambda row: None, open_port=wire.open)
        task = asyncio.create_task(line.run())
        while not line.is_open:
            await asyncio.sleep(0.01)
        master = Master(wire, language, draw)
        await master.work()
        await asyncio.sleep(1)
        task.cancel()
        await asyncio.wait([task])
        return master, line

    master, line = run_virtual(story())
    done = [at for at, reply in wire.replies if reply == language.reply]
    others = [reply for _, reply in wire.replies if reply != language.reply]
    assert all(map(language.is_error, others))
    published = Counter(one.value for one in wire.given if one.quality is Quality.GOOD)
    # Only what the master sent, and each write once; some replies gave way to the next request.
    assert all(published[value] <= master.sent[value] for value in published)
    if others:
        assert len(done) <= published.total() <= len(done) + line.unsent
    else:
        assert published.total() == len(done) + line.unsent
        assert line.unsent > 0
    assert len(done) > REQUESTS / 3
    # It answers one request with one reply, after the silence and within 10 ms.
    for at in done:
        waits = [at - asked for asked in wire.asked if asked <= at]
        assert min(waits) + 1e-9 >= language.least
        assert min(waits) <= 0.010
    assert len({at for at, _ in wire.replies}) == len(wire.replies)
