"""Programs that have a wire alone, with pyserial's client and server, on ptys and sockets."""

import asyncio
import sys
import termios
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest
import serial  # type: ignore[import-untyped]  # has no stubs
from serial.rfc2217 import Serial as Rfc2217Client  # type: ignore[import-untyped]  # no stubs

from gateway.config import built
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.open_door import OpenDoor
from gateway.parts.doors.settings import Sharing
from gateway.plant.plant import Plant
from gateway.transport import rfc2217
from gateway.transport.telnet import Setting, Telnet
from tests.transport.ends import PATIENCE, PtyMaster, free_port
from tests.transport.test_rfc2217 import FakeSerial, Managed, serving

# pyserial's client, of 2020.
pytestmark = pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
EVERY_BYTE = bytes(range(256)) * 2


class _End(Exception):
    """The end of a test: it ends the line and the door."""


def _end() -> NoReturn:
    raise _End


class Hall:
    """A line at a real port, and its raw door."""

    def __init__(self, door: OpenDoor, told: list[str]) -> None:
        self.door, self.told = door, told

    async def until(self, happened: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened():
                await asyncio.sleep(0.01)

    @property
    def open(self) -> bool:
        return self.door.line is not None and self.door.line.engine.is_open


@asynccontextmanager
async def hall(port: str, **door: Any) -> AsyncIterator[Hall]:
    device = {"protocol": "modbus-rtu", "station": 1, "tags": {"t": {"address": "holding:0"}}}
    line = {"port": port, "baudrate": 9600, "format": "8E1", "devices": {"press": device}}
    doors = {"ladder": {"line": "hall", "protocol": "rfc2217", **door}}
    config = built({"lines": {"hall": line}, "share": {"doors": doors}})
    plant, told = Plant(config), list[str]()
    sharing = config.part(Sharing)
    assert sharing is not None
    north: Any = None
    requests = GuestRequests(plant.any_address, north)
    try:
        async with asyncio.TaskGroup() as tasks:
            made = OpenDoor(
                sharing.doors[0], requests, plant, tasks, lambda _at, event: told.append(event)
            )
            tasks.create_task(made.run())
            tasks.create_task(plant.lines[0].run())
            found = Hall(made, told)
            await found.until(lambda: found.open)
            yield found
            _end()
    except* _End:
        pass


async def ends_with(master: PtyMaster, data: bytes) -> None:
    """Waits until these bytes arrive at the wire, after those that the line has sent."""
    found = b""
    while not found.endswith(data):
        found += await master.read(1)


async def tool(port: int, **settings: Any) -> Rfc2217Client:
    """Returns pyserial's client of a door, open."""

    def opened() -> Rfc2217Client:
        return Rfc2217Client(f"rfc2217://127.0.0.1:{port}?timeout=60", timeout=PATIENCE, **settings)

    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                return await asyncio.to_thread(opened)
            except serial.SerialException:  # the door is not open yet
                await asyncio.sleep(0.02)


async def test_speed_and_format_of_a_tool_reach_the_port_and_are_put_back() -> None:
    master, port = PtyMaster(), free_port()
    async with hall(master.path, listen=f"127.0.0.1:{port}") as found:
        client = await tool(port, baudrate=38400, bytesize=7, parity="O", stopbits=2)
        flags, speed = master.format()
        assert speed == termios.B38400
        assert flags & termios.CSTOPB  # a pty has neither parity nor data bits
        assert not found.open
        await asyncio.to_thread(client.write, EVERY_BYTE)
        await ends_with(master, EVERY_BYTE)
        master.write(EVERY_BYTE)
        assert await asyncio.to_thread(client.read, len(EVERY_BYTE)) == EVERY_BYTE

        asked = Telnet.request(Setting.BAUDRATE, 0)  # the present one: it hung up
        await asyncio.to_thread(client._internal_raw_write, asked)  # it has no method for it

        def change() -> None:
            client.baudrate = 4800
            client.dtr = False

        await asyncio.to_thread(client.write, b"!")
        await ends_with(master, b"!")
        assert master.format()[1] == termios.B38400
        await asyncio.to_thread(change)
        assert master.format()[1] == termios.B4800
        await asyncio.to_thread(client.close)
        await found.until(lambda: found.open)
        flags, speed = master.format()
        assert (speed, flags & termios.CSTOPB) == (termios.B9600, 0)
        assert f"it had the wire, and sent {len(EVERY_BYTE) + 1} bytes" in found.told[0]
    master.unplug()


KILLED = """
import sys, time
from serial.rfc2217 import Serial
url = f"rfc2217://127.0.0.1:{sys.argv[1]}?timeout=60"
port = Serial(url, baudrate=4800, stopbits=2, timeout=60)
port.write(b"!")
print("ready", flush=True)
time.sleep(600)
"""


async def test_settings_are_put_back_after_a_tool_was_killed() -> None:
    master, port = PtyMaster(), free_port()
    async with hall(master.path, listen=f"127.0.0.1:{port}") as found:
        (await tool(port)).close()  # the door is open
        await found.until(lambda: found.told and found.open)
        killed = await asyncio.create_subprocess_exec(
            *(sys.executable, "-W", "ignore", "-c", KILLED, str(port)),
            stdout=asyncio.subprocess.PIPE,
        )
        assert killed.stdout is not None
        try:
            async with asyncio.timeout(PATIENCE):
                assert await killed.stdout.readline() == b"ready\n"
            assert master.format()[1] == termios.B4800
            assert not found.open
        finally:
            killed.kill()
            await killed.wait()
        await found.until(lambda: found.open)
        flags, speed = master.format()
        assert (speed, flags & termios.CSTOPB) == (termios.B9600, 0)
    master.unplug()


async def test_parity_and_modem_lines_pass_to_a_device_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rfc2217, "LONGEST_WAIT", 0.2)  # it tells no modem line that it is asked for

    class Lines(FakeSerial):
        rts = dtr = True

    fake, port = Lines(cts=True), free_port()
    made = list[Managed]()

    def managed() -> Managed:
        made.append(Managed(fake))
        return made[-1]

    async with serving(managed) as where:
        at = f"rfc2217://{where.host}:{where.port}"
        async with hall(at, listen=f"127.0.0.1:{port}") as found:
            assert (fake.baudrate, fake.parity) == (9600, "E")
            client = await tool(port, baudrate=19200, bytesize=7, parity="O", stopbits=2)
            set_by_tool = (fake.baudrate, fake.bytesize, fake.parity, fake.stopbits)
            assert set_by_tool == (19200, 7, "O", 2)

            def lines() -> bool:
                client.rts = client.dtr = False
                return bool(client.cts)

            made[-1].manager.check_modem_lines(force_notification=True)
            await found.until(lambda: found.door.guests)
            assert await asyncio.to_thread(lines)
            assert (fake.rts, fake.dtr) == (False, False)
            await asyncio.to_thread(client.close)
            await found.until(lambda: found.open)
            assert (fake.rts, fake.dtr) == (True, True)
            assert (fake.baudrate, fake.bytesize, fake.parity) == (9600, 8, "E")


async def test_a_port_with_one_speed_says_so_to_the_tool() -> None:
    port = free_port()
    async with (
        serving(lambda: Managed(FakeSerial())) as where,
        hall(f"tcp://{where.host}:{where.port}", listen=f"127.0.0.1:{port}") as found,
    ):
        with pytest.raises(ValueError, match="rejected value for option 'baudrate'"):
            await asyncio.to_thread(
                lambda: Rfc2217Client(f"rfc2217://127.0.0.1:{port}", baudrate=115200)
            )
        await found.until(lambda: found.open)


async def test_a_terminal_is_followed_in_its_speed_and_released(tmp_path: Path) -> None:
    master, path = PtyMaster(), tmp_path / "hall-1"
    async with hall(master.path, protocol="raw", listen=str(path)) as found:
        await found.until(path.is_symlink)

        def opened() -> serial.Serial:
            return serial.Serial(str(path), 4800, stopbits=2, parity="E", timeout=PATIENCE)

        client = await asyncio.to_thread(opened)

        def is_followed() -> bool:
            flags, speed = master.format()
            return speed == termios.B4800 and bool(flags & termios.CSTOPB)

        await found.until(is_followed)
        client.baudrate = 19200
        client.write(b"hello")
        await ends_with(master, b"hello")
        assert master.format()[1] == termios.B19200  # before the bytes that follow it
        master.write(b"there")
        assert await asyncio.to_thread(client.read, 5) == b"there"
        found.door.release("zoe")
        await found.until(lambda: found.open)
        assert master.format()[1] == termios.B9600
        assert "released by zoe" in found.told[1]
        client.close()
    assert not path.is_symlink()
    master.unplug()
