"""No client closes the gateway to the others: bounds of connections, requests and answers."""

import asyncio
import math
import socket
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import cast

import pytest
from aiohttp import web

from gateway.contract.interfaces import History
from gateway.parts.web.connections import MOST_CONNECTIONS
from gateway.parts.web.guard import MOST_OF_CLIENT, MOST_OPEN
from gateway.parts.web.routes import drop
from gateway.tags import Sample
from tests.history.recorded import SPEED
from tests.northbound.plant import PlainDevice, PlainPlant
from tests.web.serving import DOCUMENTS, Client, serving

FOR_ALL = ("/healthz", "/readyz", "/metrics", "/", "/page.js")
LONG = {**DOCUMENTS["devices/mixer"], "requests": ["x" * 1000] * 1000}
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def connected(
    client: Client, request: str = "", by: str = "127.0.0.1", size: int = 0
) -> AsyncIterator[Streams]:
    """A connection from the address `by`, with a request that is sent on it. `size`: bytes that
    its system takes before they are read."""
    one = socket.socket()
    if size:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    one.bind((by, 0))
    one.setblocking(False)
    await asyncio.get_running_loop().sock_connect(one, ("127.0.0.1", client.port))
    streams = await asyncio.open_connection(sock=one, limit=1024 if size else 2**16)
    try:
        if request:
            streams[1].write(f"GET {request} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        yield streams
    finally:
        streams[1].transport.abort()


def length_of(head: bytes) -> int:
    return int(head.partition(b"Content-Length: ")[2].partition(b"\r\n")[0])


async def all_answered(client: Client, by: str) -> None:
    for path in FOR_ALL:
        async with asyncio.timeout(300), connected(client, path, by) as (reader, _):
            assert await reader.readline() == b"HTTP/1.1 200 OK\r\n", path


async def test_the_idlest_connection_is_closed_for_a_new_one() -> None:
    async with serving() as client, AsyncExitStack() as stack:
        page, _ = await stack.enter_async_context(connected(client, "/api/events?tags=none"))
        async with asyncio.timeout(300):
            await page.readuntil(b"event: time")
        kept = [
            await stack.enter_async_context(connected(client)) for _ in range(MOST_CONNECTIONS + 20)
        ]
        await all_answered(client, "127.0.0.1")
        async with asyncio.timeout(300):
            for reader, _ in kept[:20]:
                assert await reader.read() == b""
            await page.readuntil(b"event: time")  # it is not idle
        assert not kept[-1][0].at_eof()


async def test_a_client_with_many_connections_takes_none_of_another() -> None:
    async with serving() as client, AsyncExitStack() as stack:
        reader, writer = await stack.enter_async_context(connected(client, by="127.0.0.2"))
        for _ in range(MOST_CONNECTIONS + 1):
            await stack.enter_async_context(connected(client))
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        async with asyncio.timeout(300):
            assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"


class SlowHistory:
    """Its queries end when `gate` is set."""

    def __init__(self) -> None:
        self.gate = threading.Event()

    def samples(self, *_: object) -> Iterator[Sample]:
        self.gate.wait(300)
        return iter(())


async def test_readers_of_history_close_the_gateway_to_nobody() -> None:
    plant, slow = PlainPlant(PlainDevice(SPEED.device, (SPEED,))), SlowHistory()
    served = serving(history=cast("History", slow), plant=plant)
    async with served as client, AsyncExitStack() as stack, asyncio.timeout(300):
        address = f"/api/history?tag={SPEED.key}"
        readers = [await stack.enter_async_context(connected(client, address)) for _ in range(70)]
        assert await readers[-1][0].readline() == b"HTTP/1.1 503 Service Unavailable\r\n"
        for by in ("127.0.0.1", "127.0.0.2"):
            await all_answered(client, by)
            async with connected(client, "/api/tags", by) as (reader, _):
                assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        slow.gate.set()
        assert await readers[0][0].readline() == b"HTTP/1.1 200 OK\r\n"


async def test_clients_that_take_nothing_of_their_answers_close_the_gateway_to_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.parts.web.connections.STALLED_AFTER", math.inf)
    async with serving() as client, AsyncExitStack() as stack, asyncio.timeout(300):
        client.north.changed["devices/mixer"] = LONG
        for _ in range(MOST_OF_CLIENT):
            reading = connected(client, "/api/devices/mixer", size=4096)
            reader, _ = await stack.enter_async_context(reading)
            assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        async with connected(client, "/api/status") as (reader, _):
            assert await reader.readline() == b"HTTP/1.1 503 Service Unavailable\r\n"
        async with connected(client, "/api/status", "127.0.0.2") as (reader, _):
            assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        await all_answered(client, "127.0.0.1")


async def test_the_place_of_the_answer_that_waits_longest_for_its_client_goes_to_a_new_request(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.parts.web.connections.STALLED_AFTER", 0.0)
    async with serving() as client, AsyncExitStack() as stack, asyncio.timeout(300):
        client.north.changed["devices/mixer"] = LONG
        readers = []
        for number in range(MOST_OPEN):
            by = f"127.0.1.{1 + number}"
            reading = connected(client, "/api/devices/mixer", by, size=4096)
            readers.append((await stack.enter_async_context(reading))[0])
            assert await readers[-1].readline() == b"HTTP/1.1 200 OK\r\n"
        async with connected(client, "/api/status", "127.0.0.2") as (reader, _):
            assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        with pytest.raises((ConnectionResetError, asyncio.IncompleteReadError)):
            await readers[0].readexactly(length_of(await readers[0].readuntil(b"\r\n\r\n")))
        length = length_of(await readers[-1].readuntil(b"\r\n\r\n"))
        assert await readers[-1].readexactly(length)


async def test_a_client_that_takes_nothing_of_its_answer_is_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.parts.web.routes.PIECE_WITHIN", 0.2)
    dropped = asyncio.Event()

    def dropping(request: web.Request) -> None:
        drop(request)
        dropped.set()

    monkeypatch.setattr("gateway.parts.web.routes.drop", dropping)
    async with serving() as client, asyncio.timeout(300):
        client.north.changed["devices/mixer"] = LONG
        async with connected(client, "/api/devices/mixer", size=4096) as (reader, _):
            length = length_of(await reader.readuntil(b"\r\n\r\n"))
            await dropped.wait()
            with pytest.raises((ConnectionResetError, asyncio.IncompleteReadError)):
                await reader.readexactly(length)


async def test_a_slow_client_gets_a_whole_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.parts.web.routes.PIECE_WITHIN", 1.0)
    async with serving() as client:
        client.north.changed["devices/mixer"] = LONG
        async with asyncio.timeout(300), connected(client, "/api/devices/mixer") as (reader, _):
            length = length_of(await reader.readuntil(b"\r\n\r\n"))
            while length:
                taken = len(await reader.read(min(length, 64 * 1024)))
                assert taken
                length -= taken
                await asyncio.sleep(0.03)  # 2 MB a second: longer than the time of a piece
