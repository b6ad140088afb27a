"""Opens serial ports behind device servers and sets their baud rate and format (RFC 2217)."""

import asyncio
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress

import structlog

from gateway.errors import LineDown
from gateway.transport.port import Port, Receiver, Rfc2217Address, SerialSettings, TcpAddress
from gateway.transport.stream import StreamPort
from gateway.transport.tcp import open_tcp
from gateway.transport.telnet import (
    BINARY,
    COM_PORT,
    PARITIES,
    PURGE_BOTH,
    Acknowledged,
    Agreed,
    Consent,
    Event,
    Received,
    Send,
    Setting,
    Telnet,
)

# Many servers acknowledge only some settings, or none.
LONGEST_WAIT = 1.0  # seconds for each setting
_LONGEST_TEXT = 80
_RATE_NEAR = 0.03  # share by which two baud rates may differ

_log = structlog.get_logger(__name__)


async def open_rfc2217(
    where: Rfc2217Address, settings: SerialSettings, receiver: Receiver, *, timeout: float = 5.0
) -> Port:
    """Connects, agrees on COM-PORT-OPTION, and sets baud rate and format. Raises `LineDown`.

    `timeout` covers the connection and the agreement, which gets at least a second. Each setting
    may take another second. A setting that the server does not acknowledge is logged as a warning,
    and the port is used nevertheless.
    """
    loop = asyncio.get_running_loop()
    begin = loop.time()
    port = Rfc2217Port(receiver)
    address = TcpAddress(where.host, where.port, reach=where.reach)
    tcp = await open_tcp(address, port, timeout=timeout, baudrate=settings.baudrate)
    try:
        left = max(begin + timeout - loop.time(), LONGEST_WAIT)
        await port.set_up(tcp, settings, left)
    finally:
        if not port.is_open:  # refused, lost or cancelled
            await tcp.close()
    return port


class Rfc2217Port:
    """The `Port` of the line and the `Receiver` of the TCP connection beneath."""

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._telnet = Telnet()
        self._tcp: StreamPort | None = None
        self._early = b""  # bytes received before the port is open; servers may send first
        self.is_open = False
        self._loss: Exception | None = None
        self._acknowledged: dict[Setting, int] = {}  # with the value that the server reports
        self._changed = asyncio.Event()
        self.note = ""  # what the server did not take

    async def set_up(self, tcp: StreamPort, settings: SerialSettings, timeout: float) -> None:
        """Agrees on the options and sets baud rate and format. Raises `LineDown`."""
        self._tcp = tcp
        with suppress(LineDown):  # `lost` reports it, with the text the server sent before
            tcp.write(self._telnet.start())
        early, self._early = self._early, b""
        self.received(early)
        await self._agree(tcp, timeout)
        data_bits, parity, stop_bits = tuple(settings.format)
        requested = {
            Setting.BAUDRATE: settings.baudrate,
            Setting.DATA_BITS: int(data_bits),
            Setting.PARITY: PARITIES[parity],
            Setting.STOP_BITS: int(stop_bits),
            Setting.PURGE: PURGE_BOTH,
        }
        for setting, value in requested.items():
            await self._ask(tcp, setting, value)
        self.note = "; ".join(_refused(requested, self._acknowledged))
        if self._telnet.consent(BINARY, ours=True) is not Consent.YES:
            _log.warning(
                "binary mode not agreed",
                port=tcp.name,
                consequence="the server may change 8-bit data",
            )
        if self._loss is not None:  # lost together with the last acknowledgement
            raise self._loss
        self.is_open = True

    async def _agree(self, tcp: StreamPort, timeout: float) -> None:
        def settled() -> bool:
            return self._telnet.consent(COM_PORT, ours=True) is not Consent.ASKED

        await self._until(settled, timeout)
        match self._telnet.consent(COM_PORT, ours=True):
            case Consent.YES:
                return
            case Consent.ASKED:
                raise LineDown(
                    f"{tcp.name}: does not speak RFC 2217 (no answer to the telnet "
                    "COM-PORT-OPTION); in raw mode it is written tcp://"
                )
            case _:
                raise LineDown(f"{tcp.name}: speaks telnet, but refuses RFC 2217 (COM-PORT-OPTION)")

    async def _ask(self, tcp: StreamPort, setting: Setting, value: int) -> None:
        tcp.write(Telnet.request(setting, value))
        if not await self._until(lambda: setting in self._acknowledged, LONGEST_WAIT):
            _log.warning("setting not acknowledged", port=tcp.name, setting=setting.name.lower())
        elif self._acknowledged[setting] != value:
            _log.warning(
                "setting refused",
                port=tcp.name,
                setting=setting.name.lower(),
                requested=value,
                actual=self._acknowledged[setting],
            )

    async def adjust(self, setting: int, value: int) -> int:
        """As `Adjustable.adjust`. A server that does not acknowledge is believed."""
        asked = Setting(setting)
        if self._tcp is not None and asked is not Setting.MODEM_STATE:
            self._acknowledged.pop(asked, None)
            with suppress(LineDown):
                await self._ask(self._tcp, asked, value)
        return self._acknowledged.get(asked, value)

    async def _until(self, happened: Callable[[], bool], timeout: float) -> bool:
        """Returns True when it happens in time. Raises `LineDown` when the connection is lost."""
        try:
            async with asyncio.timeout(timeout):
                while not happened():
                    if self._loss is not None:
                        raise self._loss
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return happened()
        return True

    # The `Port` of the line.

    def write(self, data: bytes) -> None:
        if self._tcp is None:
            raise LineDown("not open")
        self._tcp.write(Telnet.encode(data))

    async def close(self) -> None:
        self.is_open = False
        if self._tcp is not None:
            await self._tcp.close()

    # The `Receiver` of the connection.

    def received(self, data: bytes) -> None:
        if self._tcp is None:
            self._early += data
            return
        for event in self._telnet.feed(data):
            self._take(event)

    def _take(self, event: Event) -> None:
        match event:
            case Received(data):
                if self.is_open:
                    self._receiver.received(data)
                else:  # received at another baud rate, or text of the server
                    self._early = (self._early + data)[:_LONGEST_TEXT]
            case Send(data):
                if self._tcp is not None:
                    with suppress(LineDown):  # `lost` reports it
                        self._tcp.write(data)
            case Agreed():
                self._changed.set()
            case Acknowledged(setting, value):
                self._acknowledged[setting] = value
                self._changed.set()

    def lost(self, error: Exception) -> None:
        text = self._early.decode("ascii", "replace").strip()
        self._loss = LineDown(f"{error}, saying {text!r}") if text and not self.is_open else error
        self._changed.set()
        if self.is_open:
            self.is_open = False
            self._receiver.lost(error)


def _refused(requested: Mapping[Setting, int], taken: Mapping[Setting, int]) -> Iterator[str]:
    """Yields a sentence for each setting of which the server says that it has another value."""
    spelt = {Setting.PARITY: {number: letter for letter, number in PARITIES.items()}}
    for setting, value in requested.items():
        found = taken.get(setting, value)
        near = setting is Setting.BAUDRATE and abs(found - value) <= _RATE_NEAR * value
        if found and found != value and not near and setting is not Setting.PURGE:
            has, wanted = (spelt.get(setting, {}).get(one, one) for one in (found, value))
            what = setting.name.lower().replace("_", " ")
            yield f"The device server has {what} {has}, not {wanted}: it refused it"
