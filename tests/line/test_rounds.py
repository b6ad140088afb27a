"""Connections that last for one round, to real servers with such limits."""

import asyncio
from typing import Any

import pytest

from gateway.tags import Quality
from tests.attacks.tcp_peer import (
    PATIENCE,
    Readings,
    made_line,
    modbus_tcp,
    peer,
    running,
    tcp_reply,
)

ROUNDS: dict[str, Any] = {"line": {"close_after": "round"}, "every": "300ms"}


class OneAtATime:
    """A server that takes one connection, and resets every other one. Its registers hold their
    own numbers."""

    def __init__(self) -> None:
        self.connected = False
        self.taken: list[int] = []  # connections with a request
        self.ended = asyncio.Event()  # set while nobody is connected

    async def __call__(
        self, number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        if self.connected:
            writer.transport.abort()
            return
        self.connected = True
        self.ended.clear()
        try:
            while request := await reader.read(12):
                self.taken.append(number)
                writer.write(tcp_reply(request))
        finally:
            self.connected = False
            self.ended.set()


async def test_the_connection_is_free_for_others_between_two_rounds() -> None:
    server, sink = OneAtATime(), Readings()
    async with peer(server) as number:
        line = made_line(number, ["holding:0", "holding:500"], sink, **ROUNDS)
        async with running(line):
            await sink.more_good(2)
            async with asyncio.timeout(PATIENCE):
                while True:  # another master
                    await server.ended.wait()
                    reader, writer = await asyncio.open_connection("127.0.0.1", number)
                    try:
                        writer.write(bytes.fromhex("000100000006010300070001"))
                        if (await reader.read(11))[-1:] == b"\x07":
                            break
                    except ConnectionError:
                        pass  # the gateway was faster
                    finally:
                        writer.close()
            await sink.more_good(8)
            assert len(set(server.taken)) >= 4  # a connection for each round


async def test_values_stay_good_between_two_rounds() -> None:
    sink = Readings()
    async with peer(lambda _, reader, writer: modbus_tcp(reader, writer)) as number:
        line = made_line(number, ["holding:7"], sink, **ROUNDS)
        async with running(line):
            await sink.more_good(6)
            assert not [one for one in sink.bad if one.reason == "line-down"]
            assert line.engine.record.last_trouble == ""
            assert line.engine.record.opened == 1


async def test_a_reply_that_breaks_off_is_a_lost_line() -> None:
    sink = Readings()

    async def serve(
        number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        if number == 3:  # the first one only shows that somebody is there
            writer.write(tcp_reply(await reader.readexactly(12))[:9])
            await writer.drain()
            return
        await modbus_tcp(reader, writer)

    async with peer(serve) as number:
        line = made_line(number, ["holding:7"], sink, **ROUNDS)
        async with running(line):
            await sink.until(lambda: "closed by" in line.engine.record.last_trouble)
            assert sink.last["t0"].quality is Quality.BAD
            await sink.more_good(3)


@pytest.mark.parametrize("rounds", [True, False])
async def test_the_first_request_waits_for_a_slow_server(rounds: bool) -> None:
    sink, deaf = Readings(), 0.2
    loop = asyncio.get_running_loop()

    async def serve(_: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        begun = loop.time()
        request = await reader.readexactly(12)
        if loop.time() - begun < deaf:
            return  # too early: it resets
        writer.write(tcp_reply(request))
        await modbus_tcp(reader, writer)

    async with peer(serve) as number:
        close = {"close_after": "round"} if rounds else {}
        settings = {"connect_delay": "400ms", **close}
        line = made_line(number, ["holding:7"], sink, line=settings, every="1s")
        async with running(line):
            await sink.more_good(3)


async def test_a_read_on_demand_connects_at_once() -> None:
    sink = Readings()
    async with peer(lambda _, reader, writer: modbus_tcp(reader, writer)) as number:
        line = made_line(number, ["holding:7"], sink, line={"close_after": "round"}, every="1h")
        async with running(line):
            await sink.more_good(1)
            [device] = line.engine.devices
            line.expedite(device, device.tags[0])
            await sink.more_good(1)
            result = await line.peek(device, device.blocks[0].span)
            assert result == "7"


async def test_nobody_listens() -> None:
    sink = Readings()
    async with peer(lambda _, reader, writer: modbus_tcp(reader, writer)) as number:
        line = made_line(number, ["holding:7"], sink, **ROUNDS)
    async with running(line):
        await sink.until(lambda: bool(sink.bad))
        assert "refused" in line.engine.record.trouble
        assert line.engine.record.opened == 0
