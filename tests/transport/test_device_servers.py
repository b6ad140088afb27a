"""A port that device servers connect to: registrations, heartbeats, connections of strangers."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from ipaddress import ip_network

import pytest

from gateway.errors import LineDown
from gateway.transport import Port, SerialSettings, open_port
from gateway.transport.device_servers import MOST_UNREGISTERED, close_doors
from gateway.transport.port import LONGEST_REGISTRATION, DeviceServer, ListenAddress, parse_port
from tests.transport.ends import PATIENCE, RecordingReceiver, free_port, listening

MODULE = "gateway.transport.device_servers"
ONE, OTHER = DeviceServer(b"DTU-1", b"ping"), DeviceServer(b"DTU-2")
ANY = SerialSettings()
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@pytest.fixture(autouse=True)
async def no_door_stays() -> AsyncIterator[None]:
    yield
    close_doors()


@asynccontextmanager
async def calling(
    where: ListenAddress, first: bytes = b"", by: str = "127.0.0.1"
) -> AsyncIterator[Streams]:
    """A device server that has connected, and sent its first bytes."""
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                streams = await asyncio.open_connection(where.host, where.port, local_addr=(by, 0))
                break
            except ConnectionRefusedError:  # the line does not listen yet
                await asyncio.sleep(0)
    streams[1].write(first)
    try:
        yield streams
    finally:
        streams[1].transport.abort()


def address(server: DeviceServer = ONE) -> ListenAddress:
    return ListenAddress("127.0.0.1", free_port(), server)


async def opened(where: ListenAddress, receiver: RecordingReceiver) -> Port:
    return await open_port(where, ANY, receiver, timeout=PATIENCE)


async def exchanged(port: Port, receiver: RecordingReceiver, far: Streams, request: bytes) -> None:
    """Sends a request, and answers it with the same bytes."""
    port.write(request)
    async with asyncio.timeout(PATIENCE):
        assert await far[0].readexactly(len(request)) == request
    before = len(receiver.data)
    far[1].write(request)
    await receiver.until(lambda r: r.data[before:] == request)


async def test_a_registered_device_server_is_the_port_of_its_line() -> None:
    where, heard = address(), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DT") as far:
        far[1].write(b"U-1")
        await exchanged(await opening, heard, far, b"request")
        assert heard.data == b"request"


async def test_registration_and_heartbeats_are_no_bytes_of_the_line() -> None:
    where, heard = address(), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DTU-1ping") as far:
        port = await opening
        await exchanged(port, heard, far, b"reply 1")
        far[1].write(b"pingpingDTU-1ping")
        await exchanged(port, heard, far, b"reply 2")
        assert heard.data == b"reply 1reply 2"


async def test_two_lines_share_a_port_by_registration() -> None:
    where, one, other = address(), RecordingReceiver(), RecordingReceiver()
    shared = ListenAddress(where.host, where.port, OTHER)
    openings = [asyncio.create_task(opened(w, h)) for w, h in ((where, one), (shared, other))]
    async with calling(where, b"DTU-2") as second, calling(where, b"DTU-1") as first:
        ports = await asyncio.gather(*openings)
        await exchanged(ports[0], one, first, b"for one")
        await exchanged(ports[1], other, second, b"for the other")
        assert (one.data, other.data) == (b"for one", b"for the other")


async def test_a_line_without_registration_takes_the_connection_there_is() -> None:
    where, heard = address(DeviceServer()), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where) as far:
        await exchanged(await opening, heard, far, b"\x00\xff")


async def test_the_sentences_say_who_has_not_connected() -> None:
    where, heard = address(DeviceServer(b"DTU-1\r")), RecordingReceiver()
    never = f"{where.host}:{where.port}: no device server has connected as DTU-1<0D>"
    with pytest.raises(LineDown, match=f"^{never}$"):
        await open_port(where, ANY, heard, timeout=0.0)
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DTU-1\r"):
        await opening
    await heard.until(lambda r: bool(r.losses))
    with pytest.raises(LineDown, match="connected again as"):
        await open_port(where, ANY, heard, timeout=0.0)
    async with calling(where, b"DTU-1\r") as far:
        await exchanged(await opened(where, heard), heard, far, b"back")


async def test_a_second_connection_replaces_a_silent_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{MODULE}.SILENT", 0.0)
    where, heard = address(), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DTU-1"):
        await opening
        async with calling(where, b"DTU-1") as second:
            await heard.until(lambda r: bool(r.losses))
            assert "connected again" in str(heard.losses[0])
            await exchanged(await opened(where, heard), heard, second, b"now here")


async def test_a_second_connection_is_refused_while_the_first_one_sends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"{MODULE}.SILENT", 1.0)
    where, heard = address(), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DTU-1") as first:
        port = await opening
        async with calling(where, b"DTU-1") as second, asyncio.timeout(PATIENCE):
            closed = asyncio.create_task(second[0].read())
            while not closed.done():
                await exchanged(port, heard, first, b"!")
            assert await _ended(closed)
        assert heard.losses == []


async def _ended(reading: "asyncio.Future[bytes]") -> bool:
    try:
        return await reading == b""
    except ConnectionResetError:
        return True


async def test_strangers_are_closed_and_the_log_says_what_they_sent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(f"{MODULE}.REGISTERS_WITHIN", 0.0)
    monkeypatch.setattr(f"{MODULE}._LOG_EVERY", 0.0)
    server = DeviceServer(b"DTU-1", networks=(ip_network("127.0.0.1"), ip_network("127.0.1.0/24")))
    where, heard = address(server), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, by="127.0.0.2") as far, asyncio.timeout(PATIENCE):
        assert await _ended(asyncio.ensure_future(far[0].read()))
    assert "no line allows its address" in capsys.readouterr().out
    other = replace(where, server=DeviceServer(b"DTU-2"))  # from any address
    second = asyncio.create_task(opened(other, RecordingReceiver()))
    async with calling(where, by="127.0.0.2") as far, asyncio.timeout(PATIENCE):
        assert await _ended(asyncio.ensure_future(far[0].read()))
    assert "no line has its registration" in capsys.readouterr().out
    second.cancel()
    monkeypatch.setattr(f"{MODULE}.REGISTERS_WITHIN", PATIENCE)
    async with calling(where, b"DTU-1", by="127.0.1.9"):
        await opening


async def test_a_flood_of_strangers_keeps_no_device_server_out() -> None:
    where, heard = address(), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with AsyncExitStack() as stack, calling(where, by="127.0.0.2") as far:
        many = range(MOST_UNREGISTERED + 20)
        strangers = [await stack.enter_async_context(calling(where, b"x")) for _ in many]
        async with asyncio.timeout(PATIENCE):
            assert await _ended(asyncio.ensure_future(strangers[0][0].read()))
        far[1].write(b"DTU-1")
        await exchanged(await opening, heard, far, b"served")


async def test_a_stranger_that_pours_is_closed_when_no_registration_can_fit_any_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"{MODULE}.REGISTERS_WITHIN", 2 * PATIENCE)
    longest = b"DTU-".ljust(LONGEST_REGISTRATION, b"7")
    where, heard = address(DeviceServer(longest)), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, longest[:-1] + b"8") as stranger, calling(where) as far:
        async with asyncio.timeout(PATIENCE):
            assert await _ended(asyncio.ensure_future(stranger[0].read()))
        far[1].write(longest)
        await exchanged(await opening, heard, far, b"served")


async def test_a_port_in_use_is_no_port_to_listen_at() -> None:
    with listening() as taken:
        where = ListenAddress("127.0.0.1", taken.getsockname()[1], ONE)
        with pytest.raises(LineDown, match="in use"):
            await open_port(where, ANY, RecordingReceiver())


async def test_a_port_that_no_line_uses_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{MODULE}.UNUSED", 0.0)
    where = address()
    with pytest.raises(LineDown):
        await open_port(where, ANY, RecordingReceiver(), timeout=0.0)
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                _, writer = await asyncio.open_connection(where.host, where.port)
                writer.transport.abort()
            except ConnectionError:
                break


def test_a_port_to_listen_at_is_written_as_an_address() -> None:
    assert parse_port("listen://[::]:5020") == ListenAddress("::", 5020)
    assert DeviceServer(networks=(ip_network("10.1.0.0/16"),)).allows("::ffff:10.1.2.3")
    assert not DeviceServer(networks=(ip_network("10.1.0.0/16"),)).allows("10.2.0.1")


# What device servers of three makers send by themselves, as their manuals print it: when they have
# connected, now and then, and the settings of the line for it.
MAKERS = {
    # USR-GPRS232-701 V1.3, 6.2: AT+CIPPACK=1,"4C4F47494E3A31303031", AT+CIPPACK=0,"4C4F47".
    "USR-GPRS232": (b"LOGIN:1001", b"LOG", DeviceServer(b"LOGIN:1001", b"LOG")),
    # USR-DR404, 3.8: AT+HEARTDT=7777772E7573722E636E; USR-N580, 5.6: the MAC address, as bytes.
    "USR-DR404": (
        bytes.fromhex("d8b04c4635ca"),
        bytes.fromhex("7777772e7573722e636e"),
        DeviceServer(bytes.fromhex("d8b04c4635ca"), b"www.usr.cn"),
    ),
    # Four-Faith, data in PROT mode: ID, telephone number, 0, address, 0; the address may change.
    "Four-Faith": (
        bytes.fromhex("78 56 34 12 31 33 30 36 36 36 36 38 38 38 38 00 c0 a8 01 42 00"),
        b"\xfe",
        DeviceServer(b"\x78\x56\x34\x1213066668888\0", b"\xfe"),
    ),
    # Moxa NPort and NE-4100 as TCP clients (6-13): keep-alives of TCP alone.
    "Moxa NPort": (b"", b"", DeviceServer()),
}


@pytest.mark.parametrize("maker", MAKERS)
async def test_what_device_servers_of_other_makers_send_is_no_reply(maker: str) -> None:
    registration, heartbeat, server = MAKERS[maker]
    where, heard = address(server), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, registration) as far:
        port = await opening
        far[1].write(heartbeat)
        await exchanged(port, heard, far, b"\x01\x03\x02\x00\x07")
        far[1].write(heartbeat + heartbeat)
        await exchanged(port, heard, far, b"\x01\x03\x02\x00\x08")
        far[1].write(registration[: len(server.registration)])
        await exchanged(port, heard, far, b"\x01\x03\x02\x00\x09")
        assert heard.data == b"".join(b"\x01\x03\x02\x00" + bytes((n,)) for n in (7, 8, 9))


async def test_the_rest_of_a_reply_keeps_the_byte_of_a_heartbeat() -> None:
    where, heard = address(DeviceServer(b"DTU-1", b"\xfe")), RecordingReceiver()
    opening = asyncio.create_task(opened(where, heard))
    async with calling(where, b"DTU-1") as far:
        port = await opening
        port.write(b"request")
        async with asyncio.timeout(PATIENCE):
            await far[0].readexactly(7)
        far[1].write(b"\xfe\x01\x03\x02")  # a heartbeat in one packet with the begin of a reply
        await heard.until(lambda r: r.data == b"\x01\x03\x02")
        far[1].write(b"\xfe")  # a heartbeat
        far[1].write(b"\xfe\x07\xb8\x44")
        await heard.until(lambda r: len(r.data) >= 6)
        assert heard.data in (b"\x01\x03\x02\xfe\x07\xb8\x44", b"\x01\x03\x02\xfe\xfe\x07\xb8\x44")
        port.write(b"request")
        far[1].write(b"\xfe\x01\x03")
        await heard.until(lambda r: r.data.endswith(b"\x44\x01\x03"))
