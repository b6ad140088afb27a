"""A raw TCP port: refused, silent, reset, half-closed, and a dead peer."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.errors import LineDown
from gateway.transport import Port, SerialSettings, TcpAddress, open_port
from gateway.transport.os_errors import line_down
from gateway.transport.port import Reach
from gateway.transport.stream import LONGEST_CLOSE, StreamPort
from tests.transport.ends import PATIENCE, RecordingReceiver, free_port, listening
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
ANY = SerialSettings()


@asynccontextmanager
async def connected(receiver: RecordingReceiver) -> AsyncIterator[tuple[Port, socket.socket]]:
    """Yields the port and the socket of the other side."""
    loop = asyncio.get_running_loop()
    with listening() as server:
        accepting = asyncio.create_task(loop.sock_accept(server))
        port = await open_port(TcpAddress(*server.getsockname()), ANY, receiver)
        peer, _ = await accepting
        peer.setblocking(False)
        with peer:
            yield port, peer
        await port.close()


def reset(peer: socket.socket) -> None:
    """Resets the connection, as a device server does after a restart."""
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()


async def test_every_byte_value_passes_both_ways() -> None:
    receiver, loop = RecordingReceiver(), asyncio.get_running_loop()
    everything = bytes(range(256))
    async with connected(receiver) as (port, peer):
        port.write(everything)
        assert await loop.sock_recv(peer, 1000) == everything
        await loop.sock_sendall(peer, everything)
        await receiver.until(lambda r: len(r.data) >= 256)
    assert receiver.data == everything
    assert receiver.losses == []


async def test_a_closed_port_is_connection_refused() -> None:
    where = TcpAddress("127.0.0.1", free_port())
    with pytest.raises(LineDown, match=rf"^127.0.0.1:{where.port}: connection refused$"):
        await open_port(where, ANY, RecordingReceiver())


async def test_a_host_with_two_addresses_that_both_refuse() -> None:
    # asyncio joins both errors in one text without a number.
    both = OSError(
        "Multiple exceptions: [Errno 111] Connect call failed ('::1', 1, 0, 0), "
        "[Errno 111] Connect call failed ('127.0.0.1', 1)"
    )
    assert str(line_down("localhost:1", both)) == "localhost:1: connection refused"


async def test_an_unknown_host_is_explained() -> None:
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert str(line_down("moxa:4001", unknown)) == "moxa:4001: unknown host"


@pytest.mark.parametrize("host", ["a..b", "x" * 300])
async def test_an_invalid_host_name_is_line_down(host: str) -> None:
    with pytest.raises(LineDown):
        await open_port(TcpAddress(host, 4001), ANY, RecordingReceiver())


async def test_a_silent_host_times_out_and_the_loop_goes_on() -> None:
    loop = asyncio.get_running_loop()
    with listening(backlog=0) as server:
        # A full backlog drops packets, like a host that is switched off.
        first = [socket.socket() for _ in range(2)]
        for one in first:
            one.setblocking(False)
            one.connect_ex(server.getsockname())
        ticks = 0
        timer: asyncio.Handle

        def tick() -> None:
            nonlocal ticks, timer
            ticks += 1
            timer = loop.call_later(0.01, tick)

        timer = loop.call_soon(tick)
        begin = loop.time()
        async with asyncio.timeout(PATIENCE):
            with pytest.raises(LineDown, match="no answer"):
                await open_port(
                    TcpAddress(*server.getsockname()), ANY, RecordingReceiver(), timeout=0.3
                )
        took = loop.time() - begin
        timer.cancel()
        for one in first:
            one.close()
    assert 0.25 < took < 2
    assert ticks > 10


async def test_a_reset_is_reported_once_and_later_writes_fail() -> None:
    receiver = RecordingReceiver()
    async with connected(receiver) as (port, peer):
        reset(peer)
        await receiver.until(lambda r: bool(r.losses))
        with pytest.raises(LineDown, match="connection reset"):
            port.write(REQUEST)
        await port.close()
        await port.close()
    assert [type(error) for error in receiver.losses] == [LineDown]
    assert "connection reset by the other side" in str(receiver.losses[0])


async def test_a_half_close_ends_the_port() -> None:
    # A device server that closes its sending side will send no more replies.
    receiver, loop = RecordingReceiver(), asyncio.get_running_loop()
    async with connected(receiver) as (port, peer):
        await loop.sock_sendall(peer, REPLY)
        peer.shutdown(socket.SHUT_WR)
        await receiver.until(lambda r: bool(r.losses))
        with pytest.raises(LineDown, match="closed by the other side"):
            port.write(REQUEST)
    assert receiver.data == REPLY  # received before the end
    assert len(receiver.losses) == 1


async def test_closing_sends_the_written_bytes_and_reports_nothing() -> None:
    receiver, loop = RecordingReceiver(), asyncio.get_running_loop()
    async with connected(receiver) as (port, peer):
        port.write(REQUEST)
        await port.close()
        assert await loop.sock_recv(peer, 1000) == REQUEST
        assert await loop.sock_recv(peer, 1000) == b""
        with pytest.raises(LineDown):
            port.write(REQUEST)
    assert receiver.losses == []


async def test_a_peer_that_accepts_no_data_is_down_and_keeps_no_old_requests() -> None:
    receiver = RecordingReceiver()
    async with connected(receiver) as (port, _):

        def keep_writing() -> None:
            for _ in range(10_000):  # the other end is not read
                port.write(REQUEST * 100)

        with pytest.raises(LineDown, match="accepts no data"):
            keep_writing()
        await receiver.until(lambda r: bool(r.losses))
    assert len(receiver.losses) == 1


async def test_a_connection_reset_at_once_is_reported_once() -> None:
    receiver, loop = RecordingReceiver(), asyncio.get_running_loop()
    with listening() as server:

        async def refuse() -> None:
            peer, _ = await loop.sock_accept(server)
            reset(peer)

        refusing = asyncio.create_task(refuse())
        try:
            port = await open_port(TcpAddress(*server.getsockname()), ANY, receiver)
        except LineDown:
            assert receiver.losses == []
        else:
            await receiver.until(lambda r: bool(r.losses))
            await port.close()
            assert len(receiver.losses) == 1
        await refusing


async def test_a_cancelled_opening_leaves_no_connection() -> None:
    with listening() as server:
        where = TcpAddress(*server.getsockname())
        opening = asyncio.create_task(open_port(where, ANY, RecordingReceiver()))
        await asyncio.sleep(0)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening


async def test_closing_does_not_wait_for_a_peer_that_accepts_no_data() -> None:
    loop = asyncio.get_running_loop()
    async with connected(RecordingReceiver()) as (port, peer):
        assert isinstance(port, StreamPort)
        # Private: only the transport knows how much it has not sent yet.
        assert port._transport is not None
        while port._transport.get_write_buffer_size() == 0:
            port.write(bytes(1000))
        begin = loop.time()
        await port.close()
        assert loop.time() - begin < LONGEST_CLOSE / 2
        arrived = 1
        while arrived:  # the buffer of the port is not sent after the close
            arrived = len(await loop.sock_recv(peer, 1_000_000))


async def test_the_addresses_of_a_device_server_are_tried_in_turn() -> None:
    """Refused, silent (its backlog is full), then one that answers; each gets its share of time."""
    receiver, loop, refuses = RecordingReceiver(), asyncio.get_running_loop(), free_port()
    with listening(backlog=0) as silent, listening() as server:
        full = [socket.socket() for _ in range(2)]
        for one in full:
            one.setblocking(False)
            one.connect_ex(silent.getsockname())
        places = (silent.getsockname(), server.getsockname())
        where = TcpAddress("127.0.0.1", refuses, reach=Reach(places))
        accepting = asyncio.create_task(loop.sock_accept(server))
        port = await open_port(where, ANY, receiver, timeout=1.0)
        peer, _ = await accepting
        with peer:
            port.write(REQUEST)
            assert await loop.sock_recv(peer, 1000) == REQUEST
            await port.close()
        where = TcpAddress("127.0.0.1", refuses, reach=Reach(places[:1]))
        with pytest.raises(LineDown) as caught:
            await open_port(where, ANY, receiver, timeout=0.2)
        for one in full:
            one.close()
    says = f"127.0.0.1:{refuses}: connection refused; 127.0.0.1:{places[0][1]}: no answer"
    assert str(caught.value) == says


async def test_the_connection_comes_from_the_address_that_is_bound() -> None:
    loop = asyncio.get_running_loop()
    with listening() as server:
        accepting = asyncio.create_task(loop.sock_accept(server))
        where = TcpAddress("127.0.0.1", server.getsockname()[1], reach=Reach(bind="127.0.0.9"))
        port = await open_port(where, ANY, RecordingReceiver())
        peer, address = await accepting
        assert address[0] == "127.0.0.9"
        peer.close()
        await port.close()
        where = TcpAddress("127.0.0.1", server.getsockname()[1], reach=Reach(bind="192.0.2.1"))
        with pytest.raises(LineDown, match="is not an address of this computer: `bind`"):
            await open_port(where, ANY, RecordingReceiver())


async def test_an_address_of_ipv6_is_written_with_brackets() -> None:
    where = TcpAddress("::1", free_port())
    with pytest.raises(LineDown, match=rf"^\[::1\]:{where.port}: "):
        await open_port(where, ANY, RecordingReceiver())


async def test_a_dead_peer_is_detected_within_a_minute_and_nothing_is_buffered() -> None:
    async with connected(RecordingReceiver()) as (port, _):
        assert isinstance(port, StreamPort)
        # Private: the options of the socket are the subject, and a port has no access to them.
        assert port._transport is not None
        ours = port._transport.get_extra_info("socket")
        asked = [
            ours.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        ]
        assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert 10 <= asked[0] + asked[1] * asked[2] <= 60
        assert 10_000 <= ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) <= 60_000
