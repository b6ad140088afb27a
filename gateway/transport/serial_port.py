"""Opens local serial ports through serialx, exclusively and without blocking the event loop."""

import asyncio
import errno
import os
import sys
from pathlib import Path

import serialx
import structlog

from gateway.errors import LineDown, words_of
from gateway.transport.os_errors import line_down
from gateway.transport.port import Receiver, SerialPath, SerialSettings
from gateway.transport.rs485 import Rs485, send_by_hand, set_direction
from gateway.transport.stream import StreamPort
from gateway.transport.telnet import PARITIES, Control, Setting

log = structlog.get_logger("gateway.line")
_SENTENCES = {
    errno.ENOENT: "no such port",
    errno.ENODEV: "no such port",
    errno.ENXIO: "no such port",
    errno.ENOTDIR: "no such port",
    errno.ENOTTY: "not a serial port",
    errno.EISDIR: "not a serial port",
    errno.EACCES: "permission denied: is the user in group dialout?",
    errno.EPERM: "permission denied: is the user in group dialout?",
    errno.EINVAL: "does not support this baud rate and format",
}
# Characters after which a quick station may reply: its first ones are lost from then on.
TARDY = 3.5
_PTYS = range(136, 144)  # Linux' major device numbers of pseudo terminals


async def open_serial(
    where: SerialPath, settings: SerialSettings, receiver: Receiver, *, timeout: float = 5.0
) -> "SerialPort":
    """Opens and locks a serial port of this computer. Raises `LineDown`.

    Bytes that the system received before are discarded.
    """
    rs485 = settings.rs485
    if rs485 is not None and rs485.by_hand:
        port: SerialPort = SwitchedPort(where.path, receiver, settings, rs485)
    else:
        port = SerialPort(where.path, receiver, settings)
    data_bits, parity, stop_bits = tuple(settings.format)
    port.is_pty = await asyncio.to_thread(_is_pty, where.path)
    if port.is_pty:
        data_bits, parity = "8", "N"
    try:
        async with asyncio.timeout(timeout):
            await serialx.create_serial_connection(
                asyncio.get_running_loop(),
                lambda: port,
                where.path,
                baudrate=settings.baudrate,
                byte_size=int(data_bits),
                parity=serialx.Parity(parity),
                stopbits=serialx.StopBits(int(stop_bits)),
                exclusive=True,
            )
        if rs485 is not None:
            set_direction(where.path, port.descriptor(), rs485)
        port.ready()
    # ValueError: an invalid path (with a NUL), a format unknown to serialx.
    except (OSError, serialx.SerialException, ValueError, LineDown) as error:
        await port.close()
        raise line_down(where.path, error, _SENTENCES) from error
    return port


class SerialPort(StreamPort):
    """An open serial port."""

    def __init__(self, name: str, receiver: Receiver, settings: SerialSettings) -> None:
        super().__init__(name, receiver, settings.baudrate)
        self._rts_is_direction = settings.rs485 is not None
        self.is_pty = False

    async def adjust(self, setting: int, value: int) -> int:
        """As `Adjustable.adjust`. Modem lines that the port has not are taken for set."""
        try:
            if setting == Setting.CONTROL:
                return await self._control(value)
            if setting == Setting.MODEM_STATE:
                return _modem_state(await self._pins())
            if self.is_pty and setting in (Setting.DATA_BITS, Setting.PARITY):
                return value
            found = await asyncio.to_thread(_adjusted, self.descriptor(), setting, value)
        except (OSError, serialx.SerialException, LineDown):
            return value if setting == Setting.CONTROL else 0
        if setting == Setting.BAUDRATE:
            self.expects(found)
        return found

    async def _pins(self) -> serialx.ModemPins:
        transport = self.transport
        if not isinstance(transport, serialx.SerialTransport):
            raise LineDown(f"{self.name}: closed")
        return await transport.get_modem_pins()

    async def _control(self, value: int) -> int:
        """Returns the state of a modem line, of the break or of the flow control: there is none."""
        pins, transport = await self._pins(), self.transport
        if not isinstance(transport, serialx.SerialTransport):
            return value
        match value:
            case Control.DTR:
                return Control.DTR_ON if pins.dtr is serialx.PinState.HIGH else Control.DTR_OFF
            case Control.RTS:
                return Control.RTS_ON if pins.rts is serialx.PinState.HIGH else Control.RTS_OFF
            case Control.DTR_ON | Control.DTR_OFF:
                await transport.set_modem_pins(dtr=value == Control.DTR_ON)
            case Control.RTS_ON | Control.RTS_OFF if not self._rts_is_direction:
                await transport.set_modem_pins(rts=value == Control.RTS_ON)
            case Control.BREAK:
                return Control.BREAK_OFF
            case Control.BREAK_ON:  # as long as the driver makes it: none is left on
                await asyncio.to_thread(_send_break, self.descriptor())
            case _ if value < Control.BREAK:
                return Control.NO_FLOW
            case _ if value >= Control.INBOUND_FLOW:
                return Control.NO_INBOUND_FLOW
        return value


class SwitchedPort(SerialPort):
    """An open serial port whose RS-485 direction this program switches."""

    def __init__(
        self, name: str, receiver: Receiver, settings: SerialSettings, wanted: Rs485
    ) -> None:
        super().__init__(name, receiver, settings)
        self._wanted = wanted
        data_bits, parity, stop_bits = tuple(settings.format)
        self._character = (
            1 + int(data_bits) + (parity != "N") + int(stop_bits)
        ) / settings.baudrate
        self._sending: asyncio.Task[None] | None = None
        self._latest = TARDY * self._character  # seconds of the latest switch that was logged

    def write(self, data: bytes) -> None:
        self._allowance.requested()
        port = os.dup(self.descriptor())  # no other port gets its number while a thread has it
        loop = asyncio.get_running_loop()
        self._sending = loop.create_task(self._send(port, data, self._sending))

    async def _send(self, port: int, data: bytes, before: asyncio.Task[None] | None) -> None:
        seconds = len(data) * self._character
        try:
            if before is not None:
                await before
            late = await asyncio.to_thread(send_by_hand, port, data, seconds, self._wanted)
        except OSError as error:
            self.break_off(f"cannot send: {words_of(error)}")
            return
        if late - self._wanted.after > self._latest:
            self._latest = 2 * (late - self._wanted.after)
            log.warning("direction switched late", port=self.name, seconds=round(late, 4))


def _send_break(port: int) -> None:
    """Blocks. Raises `OSError`."""
    import termios

    try:
        termios.tcsendbreak(port, 0)
    except termios.error as error:
        raise OSError(*error.args) from error


def _modem_state(pins: serialx.ModemPins) -> int:
    lines = ((pins.car, 128), (pins.rng, 64), (pins.dsr, 32), (pins.cts, 16))
    return sum(bit for pin, bit in lines if pin is serialx.PinState.HIGH)


def _adjusted(port: int, setting: int, value: int) -> int:
    """Changes a setting when all bytes have been sent; 0 asks only. Returns what the driver has
    then. Blocks. Raises `OSError`."""
    import termios

    from gateway.transport.terminal import RATES

    rates = {rate: code for code, rate in RATES.items()}
    sizes = {5: termios.CS5, 6: termios.CS6, 7: termios.CS7, 8: termios.CS8}
    odd = termios.PARENB | termios.PARODD
    parities = {PARITIES["N"]: 0, PARITIES["O"]: odd, PARITIES["E"]: termios.PARENB}
    stops = {1: 0, 2: termios.CSTOPB}
    masks = {
        Setting.DATA_BITS: (termios.CSIZE, sizes),
        Setting.PARITY: (odd, parities),
        Setting.STOP_BITS: (termios.CSTOPB, stops),
    }
    queues = {1: termios.TCIFLUSH, 2: termios.TCOFLUSH}
    try:
        if setting == Setting.PURGE:
            termios.tcflush(port, queues.get(value, termios.TCIOFLUSH))
            return value
        mode = termios.tcgetattr(port)
        mask, codes = masks.get(Setting(setting), (0, rates))
        if value in codes:
            if mask:
                mode[2] = mode[2] & ~mask | codes[value]
            else:
                mode[4] = mode[5] = codes[value]
            termios.tcsetattr(port, termios.TCSADRAIN, mode)
            mode = termios.tcgetattr(port)
        code = mode[2] & mask if mask else mode[5]
        return next((number for number, one in codes.items() if one == code), 0)
    except termios.error as error:
        raise OSError(*error.args) from error


def _is_pty(path: str) -> bool:
    """Returns True for a pseudo terminal, which always carries 8 bits without parity.

    Linux accepts another format once and refuses it from then on.
    """
    if sys.platform != "linux":
        return False
    try:
        return os.major(Path(path).stat().st_rdev) in _PTYS
    except (OSError, ValueError):
        return False  # the open that follows gives the reason
