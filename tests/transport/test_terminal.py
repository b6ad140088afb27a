"""Terminals with a name that stays, opened by pyserial as a serial port."""

import asyncio
import os
import termios
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import serial  # type: ignore[import-untyped]  # has no stubs

from gateway.errors import LineDown
from gateway.transport import terminal
from gateway.transport.port import Port, SerialPath
from gateway.transport.terminal import Terminal, TerminalPort
from tests.transport.ends import PATIENCE, RecordingReceiver


class Program(RecordingReceiver):
    """What the gateway has of one program."""

    def __init__(self) -> None:
        super().__init__()
        self.port: TerminalPort

    def opened(self, port: Port) -> None:
        assert isinstance(port, TerminalPort)
        self.port = port


@asynccontextmanager
async def served(path: Path) -> AsyncIterator["asyncio.Queue[Program]"]:
    """Yields the programs that open the terminal, one after another."""
    programs = asyncio.Queue[Program]()

    def connect(address: str) -> Program:
        assert address == "terminal"
        programs.put_nowait(Program())
        return programs._queue[-1]  # type: ignore[attr-defined,no-any-return]  # the one just put

    door = Terminal(SerialPath(str(path)))
    await door.open()
    work = asyncio.create_task(door.serve(connect))
    try:
        yield programs
    finally:
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        await door.close()
    assert not path.is_symlink()


async def opened(path: Path, programs: "asyncio.Queue[Program]", **settings: object) -> "Opened":
    port = await asyncio.to_thread(lambda: serial.Serial(str(path), timeout=PATIENCE, **settings))
    async with asyncio.timeout(PATIENCE):
        return Opened(port, await programs.get())


class Opened:
    """A program, and the gateway's side of it."""

    def __init__(self, tool: serial.Serial, program: Program) -> None:
        self.tool, self.program = tool, program

    async def heard(self, count: int) -> bytes:
        return await asyncio.to_thread(self.tool.read, count)

    async def closed(self) -> None:
        self.tool.close()
        await self.program.until(lambda found: bool(found.losses))


async def test_programs_open_it_one_after_another_by_the_same_name(tmp_path: Path) -> None:
    path, every = tmp_path / "hall-1", bytes(range(256))
    async with served(path) as programs:
        for number in range(2):
            one = await opened(path, programs, baudrate=19200, stopbits=2)
            # The second one may set them while those of the first are forgotten.
            assert number or one.program.port.settings() == (19200, 2)
            one.tool.write(every)
            await one.program.until(lambda found: found.data == every)
            one.program.port.write(every)
            assert await one.heard(256) == every
            await one.closed()
            assert "has closed it" in str(one.program.losses[0])


async def test_a_program_that_sets_nothing_gets_all_bytes_as_they_are(tmp_path: Path) -> None:
    every = bytes(range(256))
    async with served(tmp_path / "hall-1") as programs:
        with (tmp_path / "hall-1").open("r+b", buffering=0) as file:
            async with asyncio.timeout(PATIENCE):
                program = await programs.get()
            file.write(every)
            await program.until(lambda found: len(found.data) >= 256)
            assert program.data == every
            program.port.write(every)
            heard = b""
            while len(heard) < 256:
                heard += await asyncio.to_thread(file.read, 256) or b""
            assert heard == every


@pytest.mark.parametrize(("bits", "parity"), [(7, "E"), (8, "E"), (7, "O"), (8, "N")])
async def test_any_format_opens_again_and_again(tmp_path: Path, bits: int, parity: str) -> None:
    async with served(tmp_path / "hall-1") as programs:
        for _ in range(2):
            one = await opened(
                tmp_path / "hall-1", programs, baudrate=9600, bytesize=bits, parity=parity
            )
            await one.closed()


async def test_an_echo_that_a_program_sets_brings_no_reply_back(tmp_path: Path) -> None:
    async with served(tmp_path / "hall-1") as programs:
        one = await opened(tmp_path / "hall-1", programs)
        mode = termios.tcgetattr(one.tool.fileno())
        mode[3] |= termios.ECHO | termios.ICANON
        termios.tcsetattr(one.tool.fileno(), termios.TCSANOW, mode)
        one.program.port.write(b"reply\n")
        assert await one.heard(6) == b"reply\n"
        one.tool.write(b"x")
        await one.program.until(lambda found: bool(found.data))
        assert one.program.data == b"x"
        await one.closed()


async def test_a_program_that_is_disconnected_loses_its_port(tmp_path: Path) -> None:
    async with served(tmp_path / "hall-1") as programs:
        one = await opened(tmp_path / "hall-1", programs)
        old = (tmp_path / "hall-1").readlink()
        await one.program.port.close()
        with pytest.raises(LineDown):
            one.program.port.write(b"late")
        with pytest.raises(serial.SerialException):
            await one.heard(1)
        async with asyncio.timeout(PATIENCE):
            while not (tmp_path / "hall-1").exists() or (tmp_path / "hall-1").readlink() == old:
                await asyncio.sleep(0.01)
        one.tool.close()  # until now the system has not given its number away again
        two = await opened(tmp_path / "hall-1", programs)
        assert two.program.losses == []
        await two.closed()


async def test_a_program_that_reads_nothing_is_disconnected(tmp_path: Path) -> None:
    async with served(tmp_path / "hall-1") as programs:
        one = await opened(tmp_path / "hall-1", programs)
        with pytest.raises(LineDown, match="does not read"):
            _pour(one.program.port)
        one.tool.close()


async def test_the_next_program_gets_nothing_that_the_last_one_left(tmp_path: Path) -> None:
    async with served(tmp_path / "hall-1") as programs:
        one = await opened(tmp_path / "hall-1", programs)
        one.program.port.write(b"old")
        await one.closed()
        two = await opened(tmp_path / "hall-1", programs)
        two.program.port.write(b"new")
        assert await two.heard(3) == b"new"
        await two.closed()


def _pour(port: TerminalPort) -> None:
    for _ in range(100_000):
        port.write(bytes(4096))


def _file(path: Path) -> None:
    path.write_text("mine")


def _link(path: Path) -> None:
    path.symlink_to(path.parent)


@pytest.mark.parametrize("make", [_file, _link])
async def test_what_is_no_link_to_a_terminal_stays(
    tmp_path: Path, make: Callable[[Path], None]
) -> None:
    make(tmp_path / "hall-1")
    door = Terminal(SerialPath(str(tmp_path / "hall-1")))
    with pytest.raises(LineDown, match="no link to a terminal: remove it"):
        await door.open()
    await door.close()
    assert (tmp_path / "hall-1").exists()


async def test_the_link_of_a_killed_process_is_replaced(tmp_path: Path) -> None:
    master, slave = os.openpty()
    (tmp_path / "hall-1").symlink_to(os.ttyname(slave))
    os.close(master)
    os.close(slave)
    async with served(tmp_path / "hall-1") as programs:
        await (await opened(tmp_path / "hall-1", programs)).closed()


async def test_a_second_door_does_not_get_the_name(tmp_path: Path) -> None:
    async with served(tmp_path / "hall-1"):
        second = Terminal(SerialPath(str(tmp_path / "hall-1")))
        with pytest.raises(LineDown, match="another gateway has this terminal"):
            await second.open()
        await second.close()
        assert (tmp_path / "hall-1").is_symlink()


async def test_a_folder_that_is_missing_is_said(tmp_path: Path) -> None:
    door = Terminal(SerialPath(str(tmp_path / "nowhere" / "hall-1")))
    with pytest.raises(LineDown, match="its folder does not exist"):
        await door.open()
    await door.close()


async def test_a_link_that_is_gone_ends_the_door(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "LOOK_EVERY", 0.001)
    door = Terminal(SerialPath(str(tmp_path / "hall-1")))
    await door.open()
    (tmp_path / "hall-1").unlink()
    with pytest.raises(LineDown, match="removed or replaced the link"):
        async with asyncio.timeout(PATIENCE):
            await door.serve(lambda _: None)
    await door.close()
