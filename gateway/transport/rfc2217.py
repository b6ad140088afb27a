"""Serial ports behind device servers that take baud rate and format from us (RFC 2217)."""

import asyncio
from collections.abc import Callable
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
    Answer,
    Consent,
    Event,
    Received,
    Setting,
    Telnet,
)

# Many servers leave some settings unanswered, some answer none: nobody waits longer for one.
LONGEST_WAIT = 1.0  # seconds
_LONGEST_WORDS = 80

_log = structlog.get_logger(__name__)


async def open_rfc2217(
    where: Rfc2217Address, settings: SerialSettings, ear: Receiver, *, timeout: float = 5.0
) -> Port:
    """Connect, agree on COM-PORT-OPTION, and ask for baud rate and format. Raises `LineDown`.

    `timeout` is for the connection and the agreement (which has at least a second); each setting
    may take a second more.
    What a server does not confirm is logged as a warning, and the port is used as it is.
    """
    loop = asyncio.get_running_loop()
    begin = loop.time()
    port = Rfc2217Port(ear)
    tcp = await open_tcp(TcpAddress(where.host, where.port), port, timeout=timeout)
    try:
        left = max(begin + timeout - loop.time(), LONGEST_WAIT)
        await port.set_up(tcp, settings, left)
    finally:
        if not port.live:  # refused, lost or cancelled
            await tcp.close()
    return port


class Rfc2217Port:
    """The `Port` to its owner, and the `Receiver` of the TCP connection beneath."""

    def __init__(self, ear: Receiver) -> None:
        self._ear = ear
        self._telnet = Telnet()
        self._tcp: StreamPort | None = None
        self._early = b""  # what arrived before the port was ready; servers may speak first
        self.live = False
        self._loss: Exception | None = None
        self._said: dict[Setting, int] = {}  # what the server acknowledged, as it said it
        self._news = asyncio.Event()

    async def set_up(self, tcp: StreamPort, settings: SerialSettings, timeout: float) -> None:
        """Raises `LineDown`."""
        self._tcp = tcp
        with suppress(LineDown):  # `lost` will say so, and what the server said before
            tcp.write(self._telnet.start())
        early, self._early = self._early, b""
        self.received(early)
        await self._agree(tcp, timeout)
        data_bits, parity, stop_bits = tuple(settings.format)
        asked = {
            Setting.BAUDRATE: settings.baudrate,
            Setting.DATA_BITS: int(data_bits),
            Setting.PARITY: PARITIES[parity],
            Setting.STOP_BITS: int(stop_bits),
            Setting.PURGE: PURGE_BOTH,
        }
        for setting, value in asked.items():
            await self._ask(tcp, setting, value)
        if self._telnet.consent(BINARY, ours=True) is not Consent.YES:
            _log.warning("not agreed: 8-bit data may be changed on the way", port=tcp.name)
        if self._loss is not None:  # it came together with the last answer
            raise self._loss
        self.live = True

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
        if not await self._until(lambda: setting in self._said, LONGEST_WAIT):
            _log.warning("setting not acknowledged", port=tcp.name, setting=setting.name.lower())
        elif self._said[setting] != value:
            _log.warning(
                "setting not taken",
                port=tcp.name,
                setting=setting.name.lower(),
                asked=value,
                is_now=self._said[setting],
            )

    async def _until(self, happened: Callable[[], bool], timeout: float) -> bool:
        """Whether it happened in time. Raises `LineDown` when the connection is lost."""
        try:
            async with asyncio.timeout(timeout):
                while not happened():
                    if self._loss is not None:
                        raise self._loss
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            return happened()
        return True

    # The port to its owner.

    def write(self, data: bytes) -> None:
        if self._tcp is None:
            raise LineDown("not open")
        self._tcp.write(Telnet.encode(data))

    async def close(self) -> None:
        self.live = False
        if self._tcp is not None:
            await self._tcp.close()

    # The ear of the connection.

    def received(self, data: bytes) -> None:
        if self._tcp is None:
            self._early += data
            return
        for event in self._telnet.feed(data):
            self._take(event)

    def _take(self, event: Event) -> None:
        match event:
            case Received(data):
                if self.live:
                    self._ear.received(data)
                else:  # of another baud rate, or the server's own words
                    self._early = (self._early + data)[:_LONGEST_WORDS]
            case Answer(data):
                if self._tcp is not None:
                    with suppress(LineDown):  # `lost` will say so
                        self._tcp.write(data)
            case Agreed():
                self._news.set()
            case Acknowledged(setting, value):
                self._said[setting] = value
                self._news.set()

    def lost(self, error: Exception) -> None:
        words = self._early.decode("ascii", "replace").strip()
        self._loss = LineDown(f"{error}, saying {words!r}") if words and not self.live else error
        self._news.set()
        if self.live:
            self.live = False
            self._ear.lost(error)
