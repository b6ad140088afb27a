"""Clients of the web side that hold its places, leave half-way or lose their token."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, closing
from pathlib import Path

from gateway.parts.history.store.file import HistoryFile
from tests.e2e.processes import free_port, started, vigor_line, write_config
from tests.history.recorded import SPEED, numbered, store_run
from tests.northbound.access import secret
from tests.zenoh_peer import POLL, free_endpoint

TOKEN = "t" * 40
END = "\r\n"
HEAD = f"Host: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
BODY = "Content-Type: application/json\r\nContent-Length: {}\r\n"
HALF = BODY.format(2) + "\r\n7"
CLOSE = "Connection: close\r\n\r\n"
FOR_ALL = ("/healthz", "/readyz", "/metrics", "/", "/page.js")
HISTORY = f"GET /api/history?tag={SPEED.key}&time=[..]&limit=10000"
READERS = 70
HERE, ELSEWHERE = "127.0.0.1", "127.0.0.2"
RECIPE = "POST /api/write?tag=oven/recipe"
REFUSED = {  # requests that have two meanings, or none
    RECIPE + "&tag=oven/other": ("", "7", 400),
    RECIPE: ("Content-Encoding: compress\r\n", "7", 415),
    RECIPE + "&more=": ("", "1e-400", 400),
}
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def asking(port: int, request: str, more: str = "", by: str = HERE) -> AsyncIterator[Streams]:
    """A client at the address `by` that takes little into its buffer. `more`: after the names."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.bind((by, 0))
    one.setblocking(False)
    await asyncio.get_running_loop().sock_connect(one, ("127.0.0.1", port))
    reader, writer = await asyncio.open_connection(sock=one, limit=4096)
    try:
        writer.write(f"{request} HTTP/1.1\r\n{HEAD}{more or END}".encode())
        yield reader, writer
    finally:
        writer.transport.abort()


async def status(port: int, request: str, more: str = "", by: str = HERE) -> int:
    async with asyncio.timeout(300), asking(port, request, more, by) as (reader, _):
        return int((await reader.readline()).split()[1])


async def whole(port: int, request: str) -> bytes:
    async with asking(port, request, CLOSE) as (reader, _):
        return await reader.read()


def plant(folder: Path, port: int) -> Path:
    secret(folder / "tokens.txt", f"page:{TOKEN}\n")
    with closing(HistoryFile(folder / "history.db", 10**8)) as file:
        store_run(file, numbered(10_000, tag=SPEED.with_origin("simulated")))
    mixer = {"protocol": "vigor", "enabled": False, "tags": {"speed": {"address": "D1"}}}
    oven = vigor_line("simulator", {"recipe": {"address": "D500", "write": True}})["devices"]
    lines = {
        "hall": {"port": "simulator", "devices": {"mixer": mixer, "oven": oven["mixer"]}},
    }
    return write_config(
        folder / "plant.yaml",
        free_endpoint(),
        lines,
        defaults={"every": "200ms", "history": True},
        web={"listen": f"0.0.0.0:{port}", "tokens_file": "tokens.txt"},
        history={"path": "history.db", "keep": "3650d"},
    )


async def test_no_client_of_the_web_side_harms_another(tmp_path: Path) -> None:
    port = free_port()
    with await asyncio.to_thread(started, plant(tmp_path, port)) as program:
        await asyncio.to_thread(program.says, "web page ready")
        await asyncio.to_thread(program.says, "device online")

        async with AsyncExitStack() as stack:
            for number in range(READERS):
                by = f"127.0.1.{1 + number}"
                await stack.enter_async_context(asking(port, HISTORY, by=by))
                await stack.enter_async_context(asking(port, RECIPE, HALF, by))
            for by in (HERE, ELSEWHERE):
                found = {path: await status(port, f"GET {path}", by=by) for path in FOR_ALL}
                assert found == dict.fromkeys(FOR_ALL, 200)
        async with asyncio.timeout(300):
            while await status(port, "GET /api/tags") != 200:
                await asyncio.sleep(POLL)  # the places of those who left

        for request, (coding, body, code) in REFUSED.items():
            more = f"{coding}{BODY.format(len(body))}\r\n{body}"
            assert await status(port, request, more) == code, body
        async with asking(port, RECIPE, HALF) as (reader, writer):
            writer.write_eof()  # it leaves within its body
            assert await reader.read() == b""
        async with asking(port, "HEAD /api/events") as (reader, writer):
            assert b" 405 " in await reader.readuntil(b"\r\n\r\n")
            writer.write(f"GET /healthz HTTP/1.1\r\n{HEAD}\r\n".encode())
            assert b" 200 " in await reader.readline()  # nothing was between the answers
        assert not program.has_said("tag written")

        # The refused write is part of the state that the page shows.
        async with asyncio.timeout(300):
            while b'"bad-value":1' not in await whole(port, "GET /api/status"):
                await asyncio.sleep(POLL)
        events = asking(port, "GET /api/events", CLOSE)
        async with asyncio.timeout(300), events as (reader, _):
            shown = b""
            while b"event: time" not in shown:
                shown += (data := await reader.read(4096))
                assert data, shown
            secret(tmp_path / "tokens.txt", "# nobody\n")
            while await reader.read(4096):
                pass  # the page ends
        assert await status(port, "GET /api/status") == 401
        assert not program.has_said("Traceback")
        assert not program.has_said(TOKEN)
