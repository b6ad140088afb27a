"""RS-485 direction by the program, at a pty: it has no RTS, so that ioctl is a double."""

import asyncio
import fcntl
import struct
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.config.port_check import TRIES, port_sentences
from gateway.config import load
from gateway.errors import LineDown
from gateway.transport import SerialPath, SerialSettings, open_port
from gateway.transport.rs485 import Rs485
from tests.transport.ends import PATIENCE, PtyMaster, RecordingReceiver

BAUD = 9600
CHARACTER = 10 / BAUD  # seconds


class Rts:
    """The double of a driver with RTS: it notes when the line was switched."""

    def __init__(self) -> None:
        self.times: list[tuple[float, bool]] = []
        self.gone = False

    def ioctl(self, request: int, data: bytes) -> int:
        if self.gone:
            raise OSError(5, "Input/output error")
        assert struct.unpack("=i", data) == (termios.TIOCM_RTS,)
        self.times.append((time.monotonic(), request == termios.TIOCMBIS))
        return 0


@pytest.fixture
def rts(monkeypatch: pytest.MonkeyPatch) -> Rts:
    found, ioctl = Rts(), fcntl.ioctl

    def switched(port: int, request: int, data: Any = b"", *more: Any) -> object:
        if request in (termios.TIOCMBIS, termios.TIOCMBIC) and len(data) == 4:
            return found.ioctl(request, bytes(data))
        return ioctl(port, request, data, *more)

    monkeypatch.setattr(fcntl, "ioctl", switched)
    return found


@pytest.fixture
def plug() -> Iterator[PtyMaster]:
    made = PtyMaster()
    yield made
    made.unplug()


async def until(rts: Rts, switches: int) -> None:
    async with asyncio.timeout(PATIENCE):
        while len(rts.times) < switches:
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("sends", [True, False])
async def test_rts_is_on_from_before_the_first_bit_to_after_the_last(
    rts: Rts, plug: PtyMaster, sends: bool
) -> None:
    wanted = Rs485(rts_sends=sends, before=0.002, after=0.003, by_hand=True)
    settings, receiver = SerialSettings(BAUD, "8N1", wanted), RecordingReceiver()
    port = await open_port(SerialPath(plug.path), settings, receiver)
    assert [on for _, on in rts.times] == [not sends]  # it receives
    rts.times.clear()
    port.write(bytes(20))
    port.write(bytes(10))  # one after the other
    await until(rts, 4)
    first, second = rts.times[:2], rts.times[2:]
    for switches, characters in ((first, 20), (second, 10)):
        assert [on for _, on in switches] == [sends, not sends]
        begun, ended = switches[0][0], switches[1][0]
        # A pty takes the bytes at once, as many adapters do: the characters are waited for.
        assert ended - begun >= 0.002 + characters * CHARACTER + 0.003
    assert second[0][0] >= first[1][0]
    await port.close()


async def test_a_driver_that_fails_meanwhile_ends_the_line(rts: Rts, plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    settings = SerialSettings(BAUD, "8N1", Rs485(by_hand=True))
    port = await open_port(SerialPath(plug.path), settings, receiver)
    rts.gone = True
    port.write(b"request")
    async with asyncio.timeout(PATIENCE):
        while not receiver.losses:
            await asyncio.sleep(0.001)
    assert "cannot send: Input/output error" in str(receiver.losses[0])
    await port.close()


async def test_a_driver_without_rts_is_no_port(plug: PtyMaster) -> None:
    with pytest.raises(LineDown, match="its driver has no RTS"):
        await open_port(
            SerialPath(plug.path),
            SerialSettings(BAUD, "8N1", Rs485(by_hand=True)),
            RecordingReceiver(),
        )


FILE = """
lines:
  hall:
    port: {port}
    baudrate: 9600
    format: 8N1
    {more}
    devices:
      press: {{protocol: modbus-rtu, station: 1, tags: {{t: {{address: "holding:0"}}}}}}
"""


def written(folder: Path, port: str, more: str = "") -> Path:
    file = folder / "plant.yaml"
    file.write_text(FILE.format(port=port, more=more))
    return file


def test_check_opens_the_port_and_measures_the_switch(
    rts: Rts, plug: PtyMaster, tmp_path: Path
) -> None:
    file = written(tmp_path, plug.path, "rs485: {by: program}")
    [said], bad = port_sentences(load(file).lines)
    assert not bad
    assert f"{plug.path} opens at 9600 8N1" in said
    assert "no low latency (its driver does not have it)" in said
    assert "RTS is switched back" in said
    assert len(rts.times) == 1 + 2 * TRIES


def test_check_says_what_is_wrong_with_a_port(plug: PtyMaster, tmp_path: Path) -> None:
    lines = load(written(tmp_path, plug.path, "rs485: {by: program}")).lines
    assert port_sentences(lines) == (
        [],
        [f"line hall: {plug.path}: its driver has no RTS (Inappropriate ioctl for device)"],
    )
    good, [bad] = port_sentences(load(written(tmp_path, "/dev/none-such")).lines)
    assert good == []
    assert "no such port" in bad
