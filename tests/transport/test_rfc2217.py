"""RFC 2217 against pyserial's server, ser2net, and servers that misbehave."""

import asyncio
import termios
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from serial.rfc2217 import PortManager  # type: ignore[import-untyped]  # has no stubs
from structlog.testing import capture_logs

from gateway.errors import LineDown
from gateway.transport import (
    Port,
    Rfc2217Address,
    SerialSettings,
    TcpAddress,
    open_port,
    rfc2217,
)
from gateway.transport.port import Noted
from gateway.transport.tcp import open_tcp
from gateway.transport.telnet import Setting
from tests.conftest import needs
from tests.transport.ends import PATIENCE, PtyMaster, RecordingReceiver, free_port
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
EVERYTHING = bytes(range(256)) + b"\xff\xff\xff"
SEVEN_EVEN = SerialSettings(19200, "7E1")
IAC, SB, SE, WILL, DO, DONT, COM_PORT = 255, 250, 240, 251, 253, 254, 44


@dataclass
class FakeSerial:
    """The parts of a serial port that pyserial's `PortManager` uses."""

    baudrate: int = 9600
    bytesize: int = 8
    parity: str = "N"
    stopbits: float = 1
    cts: bool = False
    dsr: bool = False
    ri: bool = False
    cd: bool = False
    purged: list[str] = field(default_factory=list)

    def reset_input_buffer(self) -> None:
        self.purged.append("in")

    def reset_output_buffer(self) -> None:
        self.purged.append("out")


class Server(asyncio.Protocol):
    """A server with a greeting and a function that answers."""

    def __init__(self, greeting: bytes, answer: Callable[["Server", bytes], None]) -> None:
        self.greeting = greeting
        self.answer = answer
        self.got = b""

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        transport.write(self.greeting)

    def data_received(self, data: bytes) -> None:
        self.got += data
        self.answer(self, data)


@asynccontextmanager
async def serving(factory: Callable[[], asyncio.Protocol]) -> AsyncIterator[Rfc2217Address]:
    server = await asyncio.get_running_loop().create_server(factory, "127.0.0.1", 0)
    yield Rfc2217Address(*server.sockets[0].getsockname())
    server.close()
    await server.wait_closed()


class Managed(asyncio.Protocol):
    """pyserial's server over a fake serial port that echoes the data."""

    def __init__(self, port: FakeSerial) -> None:
        self.port = port
        self.got = b""

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        self.manager = PortManager(self.port, transport)

    def data_received(self, data: bytes) -> None:
        self.got += (plain := b"".join(self.manager.filter(data)))
        self.transport.write(b"".join(self.manager.escape(plain)))


@pytest.mark.parametrize(
    ("settings", "parity", "bits", "stop"),
    [(SEVEN_EVEN, "E", 7, 1), (SerialSettings(115200, "8O2"), "O", 8, 2)],
)
async def test_pyserials_server_sets_baud_rate_and_format(
    settings: SerialSettings, parity: str, bits: int, stop: int
) -> None:
    fake, receiver = FakeSerial(), RecordingReceiver()
    async with serving(lambda: Managed(fake)) as where:
        with capture_logs() as logs:
            port = await open_port(where, settings, receiver)
        assert logs == []
        assert (fake.baudrate, fake.parity, fake.bytesize, fake.stopbits) == (
            settings.baudrate, parity, bits, stop,
        )  # fmt: skip
        assert fake.purged == ["in", "out"]
        await port.close()


async def test_every_byte_value_passes_pyserials_server_both_ways() -> None:
    managed, receiver = Managed(FakeSerial()), RecordingReceiver()
    async with serving(lambda: managed) as where:
        port = await open_port(where, SerialSettings(9600, "8N1"), receiver)
        port.write(EVERYTHING)
        await receiver.until(lambda r: len(r.data) >= len(EVERYTHING))
        assert managed.got == EVERYTHING
        assert receiver.data == EVERYTHING
        await port.close()
        await port.close()
        assert receiver.losses == []
        with pytest.raises(LineDown):
            port.write(REQUEST)


@pytest.fixture
async def ser2net(tmp_path: Path) -> AsyncIterator[tuple[Rfc2217Address, PtyMaster]]:
    """ser2net with a pty for its serial port."""
    program = needs("ser2net")
    master, number = PtyMaster(), free_port()
    config = tmp_path / "ser2net.yaml"
    config.write_text(
        "connection: &a\n"
        f"  accepter: telnet(rfc2217),tcp,127.0.0.1,{number}\n"
        f"  connector: serialdev,{master.path},9600n81,local\n"
    )
    process = await asyncio.create_subprocess_exec(
        program, "-n", "-u", "-c", str(config), "-P", str(tmp_path / "pid")
    )
    async with asyncio.timeout(PATIENCE):
        while not listens(number):
            await asyncio.sleep(0.02)  # it does not report when it is ready
    yield Rfc2217Address("127.0.0.1", number), master
    process.terminate()
    await process.wait()
    master.unplug()


def listens(number: int) -> bool:
    """Returns True when the port listens. Does not connect: ser2net serves one connection."""
    listening = f"0100007F:{number:04X} 00000000:0000 0A"
    return listening in Path("/proc/net/tcp").read_text()


async def test_ser2net_sets_the_speed_and_passes_every_byte_value(
    ser2net: tuple[Rfc2217Address, PtyMaster],
) -> None:
    where, master = ser2net
    receiver = RecordingReceiver()
    port = await open_port(where, SerialSettings(19200, "8N1"), receiver)
    port.write(EVERYTHING)
    assert await master.read(len(EVERYTHING)) == EVERYTHING
    master.write(EVERYTHING)
    await receiver.until(lambda r: len(r.data) >= len(EVERYTHING))
    assert receiver.data == EVERYTHING
    _, speed = master.format()
    assert speed == termios.B19200
    await port.close()


async def test_ser2net_at_7e1_and_its_end_is_reported_once(
    ser2net: tuple[Rfc2217Address, PtyMaster],
) -> None:
    where, master = ser2net
    receiver = RecordingReceiver()
    port = await open_port(where, SEVEN_EVEN, receiver)
    port.write(REQUEST)
    assert await master.read(len(REQUEST)) == REQUEST
    master.unplug()
    await receiver.until(lambda r: bool(r.losses))
    with pytest.raises(LineDown):
        port.write(REQUEST)
    await port.close()
    assert len(receiver.losses) == 1


async def refused(server: Server, timeout: float = 0.2) -> str:
    receiver = RecordingReceiver()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rfc2217, "LONGEST_WAIT", timeout)
        return await _refused(server, receiver, timeout)


async def _refused(server: Server, receiver: RecordingReceiver, timeout: float) -> str:
    async with serving(lambda: server) as where:
        with pytest.raises(LineDown) as caught:
            await open_port(where, SEVEN_EVEN, receiver, timeout=timeout)
    assert receiver.data == b""
    assert receiver.losses == []
    return str(caught.value)


async def test_a_raw_port_is_refused_with_a_hint() -> None:
    silent = Server(b"", lambda *_: None)
    assert "does not speak RFC 2217" in (said := await refused(silent))
    assert "tcp://" in said


async def test_a_serial_device_that_streams_is_refused() -> None:
    talking = Server(REPLY, lambda server, _: server.transport.write(REPLY))
    assert "does not speak RFC 2217" in await refused(talking)


async def test_a_telnet_server_without_com_port_is_refused_at_once() -> None:
    shell = Server(
        b"login: ", lambda server, _: server.transport.write(bytes((IAC, DONT, COM_PORT)))
    )
    begin = asyncio.get_running_loop().time()
    assert "refuses RFC 2217" in await refused(shell, timeout=PATIENCE)
    assert asyncio.get_running_loop().time() - begin < PATIENCE / 2


async def test_a_server_that_closes_during_the_agreement_is_line_down() -> None:
    hanging_up = Server(b"", lambda server, _: server.transport.close())
    assert "closed by the other side" in await refused(hanging_up)


async def test_the_text_of_a_server_whose_port_is_in_use_is_quoted() -> None:
    class Taken(Server):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            transport.close()

    said = await refused(Taken(b"Port already in use\r\n", lambda *_: None))
    assert said.endswith(": closed by the other side, saying 'Port already in use'")


def agree(server: Server, data: bytes) -> None:
    if server.got == data:  # only the first time
        server.transport.write(bytes((IAC, DO, COM_PORT)))


async def test_a_missing_acknowledgement_is_logged_and_the_port_is_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rfc2217, "LONGEST_WAIT", 0.02)
    receiver, server = RecordingReceiver(), Server(b"", agree)
    async with serving(lambda: server) as where:
        with capture_logs() as logs:
            port: Port = await open_port(where, SEVEN_EVEN, receiver)
        unanswered = [row["setting"] for row in logs if row["event"] == "setting not acknowledged"]
        assert unanswered == ["baudrate", "data_bits", "parity", "stop_bits", "purge"]
        assert bytes((IAC, SB, COM_PORT, 3, 3, IAC, SE)) in server.got  # parity even
        server.transport.write(REPLY)
        await receiver.until(lambda r: len(r.data) >= len(REPLY))
        assert receiver.data == REPLY
        await port.close()


async def test_a_server_that_sets_something_else_is_logged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rfc2217, "LONGEST_WAIT", 0.02)

    def eight_bits_only(server: Server, data: bytes) -> None:
        agree(server, data)
        if bytes((IAC, SB, COM_PORT, 2)) in data:
            server.transport.write(bytes((IAC, SB, COM_PORT, 102, 8, IAC, SE)))

    async with serving(lambda: Server(b"", eight_bits_only)) as where:
        with capture_logs() as logs:
            port = await open_port(where, SEVEN_EVEN, RecordingReceiver())
        await port.close()
    row = next(row for row in logs if row["event"] == "setting refused")
    assert (row["setting"], row["requested"], row["actual"]) == ("data_bits", 7, 8)
    assert isinstance(port, Noted)
    assert port.note == "The device server has data bits 8, not 7: it refused it"


@pytest.mark.parametrize(
    ("taken", "note"),
    [
        ({}, ""),
        ({Setting.BAUDRATE: 19230, Setting.PARITY: 3, Setting.PURGE: 1}, ""),
        ({Setting.BAUDRATE: 0}, ""),
        ({Setting.BAUDRATE: 9600}, "The device server has baudrate 9600, not 19200: it refused it"),
        ({Setting.PARITY: 1}, "The device server has parity N, not E: it refused it"),
    ],
)
def test_a_setting_that_the_server_refused_is_said(taken: dict[Setting, int], note: str) -> None:
    requested = {Setting.BAUDRATE: 19200, Setting.PARITY: 3, Setting.PURGE: 3}
    assert "; ".join(rfc2217._refused(requested, taken)) == note


async def test_a_server_lost_with_its_last_acknowledgement_is_line_down() -> None:
    class Gone:
        """A connection that ends with the reply to the last request."""

        name = "10.0.0.7:4001"

        def write(self, data: bytes) -> None:
            if data[:2] != bytes((IAC, SB)):
                port.received(bytes((IAC, DO, COM_PORT)))
                return
            number, value = data[3], data[4:-2]
            port.received(bytes((IAC, SB, COM_PORT, number + 100, *value, IAC, SE)))
            if number == 12:
                port.lost(LineDown("gone"))

    receiver = RecordingReceiver()
    port: Any = rfc2217.Rfc2217Port(receiver)
    with pytest.raises(LineDown, match="gone"):
        await port.set_up(Gone(), SEVEN_EVEN, 1.0)
    assert not port.is_open
    assert receiver.losses == []


async def test_a_server_may_send_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rfc2217, "LONGEST_WAIT", 0.02)
    greeting = bytes((IAC, DO, COM_PORT, IAC, WILL, COM_PORT)) + REPLY
    receiver, server = RecordingReceiver(), Server(greeting, lambda *_: None)
    port = rfc2217.Rfc2217Port(receiver)
    async with serving(lambda: server) as where:
        tcp = await open_tcp(TcpAddress(where.host, where.port), port)
        async with asyncio.timeout(PATIENCE):
            # Private: nothing else shows that the greeting arrived before the first byte is sent.
            while len(port._early) < len(greeting):
                await asyncio.sleep(0)
        with capture_logs():
            await port.set_up(tcp, SEVEN_EVEN, 0.1)
        assert bytes((IAC, DO, COM_PORT)) in server.got
        await port.close()
    assert receiver.data == b""  # may be of another baud rate


async def test_a_cancelled_opening_closes_the_connection() -> None:
    class Watched(Server):
        gone = False

        def connection_lost(self, _: Exception | None) -> None:
            self.gone = True

    server = Watched(b"", lambda *_: None)
    async with serving(lambda: server) as where:
        opening = asyncio.create_task(open_port(where, SEVEN_EVEN, RecordingReceiver()))
        async with asyncio.timeout(PATIENCE):
            while not server.got:
                await asyncio.sleep(0.001)
            opening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await opening
            while not server.gone:
                await asyncio.sleep(0.001)
