"""The part of `check` that opens serial ports: what their drivers take over."""

import asyncio
import os
import struct
import sys
from collections.abc import Sequence

from gateway.config import LineConfig
from gateway.errors import LineDown, words_of
from gateway.transport.port import SerialPath
from gateway.transport.rs485 import Rs485, send_by_hand
from gateway.transport.serial_port import SerialPort, open_serial

TRIES = 20
CHARACTERS = 8  # of a Modbus request
_GET_SERIAL, _LOW_LATENCY = 0x541E, 1 << 13  # TIOCGSERIAL, ASYNC_LOW_LATENCY of linux/tty_flags.h


class _Unread:
    """Receives nothing: no request is sent."""

    def received(self, data: bytes) -> None: ...

    def lost(self, error: Exception) -> None: ...


def port_sentences(lines: Sequence[LineConfig]) -> tuple[list[str], list[str]]:
    """Opens each serial port of the lines. Returns what drivers take over, and what is wrong.

    Sends no character. Where this program switches RS-485, it switches `TRIES` times.
    """
    good, bad = list[str](), list[str]()
    for line in lines:
        if isinstance(line.port, SerialPath):
            try:
                good.append(asyncio.run(_tried(line, line.port)))
            except LineDown as error:
                bad.append(f"line {line.name}: {error}")
    return good, bad


async def _tried(line: LineConfig, where: SerialPath) -> str:
    serial = line.serial
    port = await open_serial(where, serial, _Unread())
    try:
        said = [f"line {line.name}: {port.name} opens at {serial.baudrate} {serial.format}"]
        said.append(_low_latency(port.descriptor()))
        if serial.rs485 is not None and serial.rs485.by_hand:
            said.append(await _by_hand(port, serial.rs485, line.wire.character))
        elif serial.rs485 is not None:
            said.append("the kernel switches RS-485")
        return ", ".join(said)
    finally:
        await port.close()


def _low_latency(port: int) -> str:
    """Returns what the driver says of its timer: 16 ms of many adapters, without low latency."""
    if sys.platform != "linux":
        return "low latency is not known here"
    import fcntl

    try:
        found = struct.unpack_from("=5i", fcntl.ioctl(port, _GET_SERIAL, bytes(256)))
    except OSError:
        return "no low latency (its driver does not have it)"
    return "low latency" if found[4] & _LOW_LATENCY else "no low latency (not permitted)"


async def _by_hand(port: SerialPort, wanted: Rs485, character: float) -> str:
    """Returns how late RTS is switched back on this computer, now."""
    late = list[float]()
    try:
        for _ in range(TRIES):
            own = os.dup(port.descriptor())
            send = asyncio.to_thread(send_by_hand, own, b"", CHARACTERS * character, wanted)
            late.append(await send)
    except OSError as error:
        raise LineDown(f"{port.name}: RTS is not switched: {words_of(error)}") from error
    middle, worst = sorted(late)[TRIES // 2], max(late)
    return (
        f"RTS is switched back {middle * 1e3:.1f} ms after the last bit, {worst * 1e3:.1f} ms at "
        f"worst ({worst / character:.1f} characters): a station must not reply sooner"
    )
