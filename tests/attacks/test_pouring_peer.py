"""A peer that pours bytes without limit: a broken device server, or a wrong port number."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from gateway.transport.loop import new_event_loop
from tests.attacks.tcp_peer import Readings, made_line, modbus_tcp, peer, running

NOISE = bytes(range(256)) * 64  # with starts of frames of every protocol
STARTS = b"\x01\x03\x00" * 5000 + b":010304" * 2000 + b"\x02010" * 4000 + b"\x0201" * 4000


@contextmanager
def pouring() -> Iterator[int]:
    """A server in a thread that sends to each connection as fast as the other side takes it."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with suppress(OSError):  # closed at the end
                while True:
                    connection, _ = server.accept()
                    with connection, suppress(ConnectionError):
                        while True:
                            connection.sendall(NOISE + STARTS)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
    thread.join()


async def answers(number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await modbus_tcp(reader, writer)


@pytest.mark.parametrize("protocol", ["modbus-tcp", "modbus-rtu", "vigor", "computer-link"])
def test_a_peer_that_pours_goes_down_and_does_not_hold_up_other_lines(protocol: str) -> None:
    with asyncio.Runner(loop_factory=new_event_loop) as runner, pouring() as bad:
        runner.run(beside_a_healthy_line(protocol, bad))


async def beside_a_healthy_line(protocol: str, bad: int) -> None:
    address = {"vigor": "D7", "computer-link": "D7"}.get(protocol, "holding:7")
    healthy, poured = Readings(), Readings()
    async with peer(answers) as good:
        other = made_line(good, ["holding:7"], healthy)
        line = made_line(bad, [address], poured, stations=31, protocol=protocol)
        async with running(other):
            await healthy.more_good(1)
            async with running(line):
                await poured.until(lambda: line.engine.record.last_trouble != "")
                await healthy.more_good(20)
                why = line.engine.record.last_trouble
    assert "bytes/s: more than the wire can carry" in why
    assert poured.good == 0
    assert healthy.bad == []
