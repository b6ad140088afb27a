"""A port without a clock of its own, and a transaction on it."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gateway.line.channel import Channel, Echo
from gateway.line.send_permit import SendPermit
from gateway.line.transaction import Transaction
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.vigor import Vigor
from gateway.stations.vigor import VigorStation
from tests.sim.plant import made_device
from tests.sim.virtual import now

WIRE = WireTiming(9600, 10)
SPAN = Span("D", 0, 2)


class FakePort:
    """A port with a station behind it. The test sets when each reply arrives."""

    def __init__(self, station: Any = None) -> None:
        self.station = station or VigorStation(1)
        self.sent: list[tuple[float, bytes]] = []
        self.after: Callable[[int], float | None] = lambda number: 0.1  # seconds; None: no reply
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        self.talk: Transaction | None = None

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        reply = b"".join(self.station.hear(data, now()))
        delay = self.after(len(self.sent))
        if reply and delay is not None:
            self.say(self.spoil(reply), delay)

    def say(self, data: bytes, delay: float = 0.0) -> None:
        asyncio.get_running_loop().call_later(delay, self._deliver, data)

    def _deliver(self, data: bytes) -> None:
        assert self.talk is not None
        self.talk.received(data)

    async def close(self) -> None: ...


def opened(
    port: FakePort,
    driver: AnyDriver | None = None,
    *,
    quiet_since: float = 0.0,
    baudrate: int = 9600,
    echo: bool = False,
    needs_resync: bool = False,
    unmatched: list[Any] | None = None,
    duty: SendPermit | None = None,
) -> Transaction:
    """A transaction on the port. `unmatched` collects the frames that are no reply."""
    driver = driver or Vigor(station=1)
    wire = WireTiming(baudrate, 10)
    timing = replace(driver.timing, reply_timeout=0.3, silence=0.005, silence_chars=0.0)
    device = made_device("plc", driver, wire, timing, ())
    if not needs_resync:
        device.health.answered()
    may_not_send = (duty or SendPermit()).why_not
    channel = Channel(port, wire, WireLog(), Echo("test", echo), may_not_send=may_not_send)
    channel.quiet_since = quiet_since
    frames = [] if unmatched is None else unmatched
    port.talk = Transaction(channel, device, lambda _, frame, echo: frames.append(frame))
    return port.talk


def read(talk: Transaction, span: Span = SPAN) -> Any:
    return Vigor(station=1).read(talk, span)


class EchoingPort(FakePort):
    """A two-wire adapter that echoes each request, with `added` before it."""

    added = b""
    adapter = True

    def write(self, data: bytes) -> None:
        if self.adapter:
            self.say(self.added + data, 0.01)
        super().write(data)
