"""RS-485 direction by the kernel: the structure of linux/serial.h, and drivers that cannot."""

import fcntl
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import serialx

from gateway.errors import LineDown
from gateway.transport import SerialPath, SerialSettings, open_port
from gateway.transport.rs485 import Rs485
from tests.transport.ends import PtyMaster, RecordingReceiver

GET, SET = 0x542E, 0x542F  # TIOCGRS485, TIOCSRS485: asm-generic/ioctls.h


class Driver:
    """The double of a driver: it notes what it is asked, and keeps what it can do of it."""

    def __init__(self, longest_ms: int = 100, flags: int = 0xFF) -> None:
        self.asked: list[tuple[int, ...]] = []
        self._longest, self._flags = longest_ms, flags
        self._kept = bytes(32)

    def ioctl(self, _port: int, request: int, data: bytes) -> bytes:
        if request == GET:
            return self._kept
        assert (request, len(data)) == (SET, 32)
        flags, before, after, *rest = words = struct.unpack("=8I", data)
        self.asked.append(words)
        delays = (min(before, self._longest), min(after, self._longest))
        self._kept = struct.pack("=8I", flags & self._flags, *delays, *rest)
        return data


async def opened(monkeypatch: pytest.MonkeyPatch, driver: Driver, wanted: Rs485) -> None:
    plug, ioctl = PtyMaster(), fcntl.ioctl

    def switched(port: int, request: int, data: bytes = b"", *more: Any) -> object:
        known = driver.ioctl if request in (GET, SET) else ioctl
        return known(port, request, data, *more)

    monkeypatch.setattr(fcntl, "ioctl", switched)
    settings = SerialSettings(19200, "8N1", wanted)
    try:
        port = await open_port(SerialPath(plug.path), settings, RecordingReceiver())
        await port.close()
    finally:
        plug.unplug()


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (Rs485(), (0b00011, 0, 0)),  # enabled, RTS on send
        (Rs485(rts_sends=False), (0b00101, 0, 0)),  # enabled, RTS after send
        (Rs485(before=0.002, after=0.029, hears_itself=True), (0b10011, 2, 29)),
    ],
)
async def test_the_kernel_gets_its_structure(
    monkeypatch: pytest.MonkeyPatch, wanted: Rs485, words: tuple[int, ...]
) -> None:
    driver = Driver()
    await opened(monkeypatch, driver, wanted)
    assert driver.asked == [(*words, 0, 0, 0, 0, 0)]


@pytest.mark.parametrize("driver", [Driver(longest_ms=1), Driver(flags=0b00001)])
async def test_a_driver_that_keeps_something_else_is_no_port(
    monkeypatch: pytest.MonkeyPatch, driver: Driver
) -> None:
    with pytest.raises(LineDown, match="does not switch RS-485 as `rs485` says: it has flags"):
        await opened(monkeypatch, driver, Rs485(after=0.005))


async def test_a_driver_without_rs485_says_what_to_do() -> None:
    plug = PtyMaster()
    settings = SerialSettings(19200, "8N1", Rs485())
    try:
        with pytest.raises(LineDown, match="remove `rs485` if the adapter switches by itself"):
            await open_port(SerialPath(plug.path), settings, RecordingReceiver())
    finally:
        plug.unplug()


PATCH = Path(__file__).parent / "upstream" / "serialx-rs485.patch"
UPSTREAM = """
import asyncio, fcntl, os, struct, sys
import serialx
from serialx.common import Rs485Settings, UnsupportedSetting

kept, ioctl = bytes(32), fcntl.ioctl
can = int(sys.argv[1])  # the flags that the driver can

def switched(port, request, data=b"", *more):
    global kept
    if request == 0x542F:
        flags, *rest = struct.unpack("=8I", data)
        kept = struct.pack("=8I", flags & can, *rest)
    return kept if request in (0x542E, 0x542F) else ioctl(port, request, data, *more)

async def main():
    master, slave = os.openpty()
    rs485 = Rs485Settings(delay_before_rx=0.029, loopback=True)
    made = serialx.create_serial_connection(
        asyncio.get_running_loop(), asyncio.Protocol, os.ttyname(slave), 19200, rs485=rs485)
    try:
        transport, _ = await made
        transport.close()
    except UnsupportedSetting:
        print("refused")
    print(*struct.unpack("=8I", kept)[:3])

fcntl.ioctl = switched
asyncio.run(main())
"""


@pytest.mark.parametrize(("can", "said"), [(0xFF, "19 0 29"), (1, "refused 1 0 29")])
def test_the_patch_for_serialx_does_the_same(tmp_path: Path, can: int, said: str) -> None:
    package = Path(serialx.__file__).parent
    shutil.copytree(package, tmp_path / "serialx", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["git", "apply", PATCH], cwd=tmp_path, check=True)
    patched = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", UPSTREAM, str(can)]
    done = subprocess.run(command, env=patched, cwd=tmp_path, capture_output=True, text=True)  # noqa: PLW1510
    assert done.stdout.split() == said.split(), done.stderr
