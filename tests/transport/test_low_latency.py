"""Low latency by the driver (`ASYNC_LOW_LATENCY`), which serialx asks for: with a double of it."""

import errno
import fcntl
from typing import Any

import pytest

from gateway.transport import SerialPath, SerialSettings, open_port
from tests.transport.ends import PtyMaster, RecordingReceiver

GET, SET = 0x541E, 0x541F  # TIOCGSERIAL, TIOCSSERIAL: asm-generic/ioctls.h
FLAGS, LOW = 4, 1 << 13  # of struct serial_struct, as int; ASYNC_LOW_LATENCY of linux/tty_flags.h
HAS = [4, 7, 0, 3, 0x40, 16, 0, 24_000_000]  # type, line, port, irq, flags, fifo, divisor, base


class Driver:
    """It has the first fields of the structure, and takes them over, or refuses."""

    def __init__(self, error: int = 0) -> None:
        self.has, self._error = list(HAS), error

    def ioctl(self, request: int, data: Any) -> int:
        if request == GET:
            data[: len(HAS)] = type(data)("i", self.has)
        elif self._error:
            raise OSError(self._error, "refused")
        else:
            self.has = list(data[: len(HAS)])
        return 0


@pytest.mark.parametrize("error", [0, errno.ENOTTY, errno.EPERM])
async def test_a_port_gets_low_latency_where_the_driver_has_it(
    monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    driver, plug, ioctl = Driver(error), PtyMaster(), fcntl.ioctl

    def switched(port: int, request: int, data: Any = b"", *more: Any) -> object:
        if request in (GET, SET):
            return driver.ioctl(request, data)
        return ioctl(port, request, data, *more)

    monkeypatch.setattr(fcntl, "ioctl", switched)
    settings = SerialSettings(19200, "8N1")
    try:
        port = await open_port(SerialPath(plug.path), settings, RecordingReceiver())
        await port.close()
    finally:
        plug.unplug()
    kept = HAS[FLAGS] if error else HAS[FLAGS] | LOW
    assert driver.has == [*HAS[:FLAGS], kept, *HAS[FLAGS + 1 :]]
