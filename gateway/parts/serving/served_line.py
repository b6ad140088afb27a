"""A served line: one wire on which the gateway is a station, or several, of a master.

The line decides nothing. It passes received bytes to an answering machine, sends its reply, and
hands what the master wrote to the sample sink.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

import structlog

from gateway.config import LineConfig
from gateway.engine.device.records import COMPLETE, CallState, LineRecord
from gateway.errors import LineDown
from gateway.line.opening import REOPEN_LONGEST, OpenPort, Pauses
from gateway.line.send_permit import SendPermit
from gateway.line.wire_log import WireLog
from gateway.parts.serving.conversation import Conversation
from gateway.stations.served.answering import Answerer, Answering, Heard, Wire
from gateway.stations.served.echo import Echo
from gateway.stations.served.registers import Registers, Served, ServedTag
from gateway.stations.served.registry import answerer
from gateway.stations.served.station import Presence, ServedStation
from gateway.stations.store import ReadOnly
from gateway.tags import Sample
from gateway.transport import (
    ModemAddress,
    Port,
    TcpAddress,
    open_modem,
    open_port,
    prepare,
)
from gateway.transport.listen import Listener
from gateway.transport.tls import certificate_of

log = structlog.get_logger("gateway.line")
NEVER = float("inf")


class ServedSink(Protocol):
    """Receives what the master writes, and its presence, on the event loop."""

    def samples(self, samples: Sequence[Sample]) -> None: ...

    def online(self, device: ServedStation, online: bool) -> None: ...


class ServedLine:
    """The task of one served line."""

    def __init__(
        self,
        config: LineConfig,
        sink: ServedSink,
        sample_of: Callable[[ServedTag], Sample | None],
        *,
        open_port: OpenPort | None = None,
        wall: Callable[[], int] = time.time_ns,
        duty: SendPermit | None = None,
    ) -> None:
        """`sample_of`: the present sample of a row. `wall`: ns since 1970."""
        self.config = config
        self.stations = {
            device.driver.station: ServedStation(
                device.name, device.driver, Registers(device.served or Served(rows=()), sample_of)
            )
            for device in config.devices
            if device.enabled
        }
        self.opened: float | None = None  # by the loop's clock; None: closed
        self.record = LineRecord()  # how often it was opened, why it is closed, calls
        self.stale = 0  # requests that later bytes have followed
        self.unsent = 0  # replies that later bytes have followed
        self._echo = Echo(config.echo)
        self._sink = sink
        self._open_port = open_port
        prepare(config.port)
        self._wall = wall
        self._duty = duty or SendPermit()
        self.wire_log = WireLog()
        self._lost = False
        self._wake = asyncio.Event()  # the port is lost, or a master is there again

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def is_open(self) -> bool:
        return self.opened is not None

    # The task

    async def run(self) -> None:
        """Serves the line until cancelled. Its errors do not end other lines."""
        pauses = Pauses(self.name)
        while True:
            begun = _now()
            try:
                await self._open_and_serve()
            except LineDown as error:
                known = str(error) == self.record.trouble
                (log.debug if known else log.warning)("line down", line=self.name, why=str(error))
                self._closed(str(error))
            if _now() - begun > REOPEN_LONGEST:
                pauses.restart()
            await asyncio.sleep(pauses.take())

    async def _open_and_serve(self) -> None:
        """Serves until the port is lost. Raises `LineDown`."""
        where = self.config.port
        self._lost = False
        if isinstance(where, TcpAddress) and self._over_network:
            listener = Listener(where)
            await listener.open()
            try:
                self._begin()
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._watch())
                    tasks.create_task(listener.serve(lambda _: Conversation(self, network=True)))
            except* LineDown as lost:
                raise LineDown(str(lost.exceptions[0])) from lost
            finally:
                await listener.close()
        else:
            conversation = Conversation(self)
            opens = self._open_port or self._opener()
            port = await opens(conversation)
            try:
                conversation.opened(port)
                self._begin()
                await self._watch()
            finally:
                conversation.close()
                await port.close()
            raise LineDown(conversation.trouble)

    def _opener(self) -> OpenPort:
        config, modem = self.config, self.config.modem
        if isinstance(config.port, ModemAddress) and modem is not None:
            where = config.port
            return lambda to: open_modem(where, config.serial, modem, to, answers=True)
        return lambda receiver: open_port(config.port, config.serial, receiver)

    @property
    def _over_network(self) -> bool:
        return any(one.driver.traits.over_network for one in self.stations.values())

    def _begin(self) -> None:
        log.info("line open", line=self.name)
        self.opened = _now()
        self.record.opened += 1
        self.record.trouble = ""
        if isinstance(self.config.port, ModemAddress):
            self.record.telephone()
        for station in self.stations.values():
            station.opened(self.opened)

    def _closed(self, why: str) -> None:
        self.opened, self.record.trouble = None, why
        if self.record.calls is not None:
            self.record.calls.lose(why, _now())
        for station in self.stations.values():
            was = station.presence
            self._give(station.lost(self._wall(), why))
            if was is Presence.PRESENT:
                self._sink.online(station, False)

    async def _watch(self) -> None:
        """Reports a master that became silent. Returns when the port is lost."""
        while not self._lost:
            for station in self.stations.values():
                self._expire(station)
            due = min((station.due for station in self.stations.values()), default=NEVER)
            self._wake.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout_at(None if due == NEVER else due):
                    await self._wake.wait()

    def _expire(self, station: ServedStation) -> None:
        was = station.presence
        self._give(station.expire(_now(), self._wall()))
        if station.presence is Presence.SILENT is not was:
            log.warning("master silent", line=self.name, device=station.name)
            if was is Presence.PRESENT:
                self._sink.online(station, False)

    # The conversations

    def may_write(self, port: Port) -> bool:
        """Returns False for a master whose certificate has no role that may write."""
        where = self.config.port
        if not isinstance(where, TcpAddress) or where.tls is None:
            return True
        from gateway.contract.access.certificates import may_write  # its TLS takes 10 ms

        return may_write(where.tls, certificate_of(port))

    def machine(self, *, may_write: bool = True) -> Answerer:
        """Returns a new answering machine for the stations."""
        devices = [one for one in self.config.devices if one.enabled]
        timing, wire = devices[0].timing, self.config.wire
        usual = wire.silence(timing) if timing.silence_chars else 0.0
        stations = {
            number: Answering(
                station.driver, station.registers if may_write else ReadOnly(station.registers)
            )
            for number, station in self.stations.items()
        }
        made = Wire(
            character=wire.character,
            silence=usual if devices[0].turnaround is None else devices[0].turnaround,
            gap=self.config.request_gap,
            echo=self._echo,
        )
        return answerer(devices[0].driver.protocol, stations, made)

    def why_not(self, now: float) -> str:
        """Returns the reason to answer nothing now; empty: none."""
        return self._duty.why_not(now, now)

    def heard(self, data: bytes) -> None:
        if self.wire_log.active:
            self.wire_log.heard(data)

    def sent(self, data: bytes) -> None:
        if self.wire_log.active:
            self.wire_log.sent(data)

    def take(self, heard: Heard, now: float) -> None:
        """Publishes what the master wrote, all of one request with one time."""
        self.stale += heard.stale
        at = self._wall()
        for done in heard.done:
            station = self.stations[done.station]
            was = station.presence
            samples = station.asked(done, now, at)
            if was is not Presence.PRESENT:
                log.info("master present", line=self.name, device=station.name)
                self._sink.online(station, True)
                self._wake.set()
            self._give(samples)
            if done.refused:
                log.debug("request refused", device=station.name, code=done.refused)

    def _give(self, samples: Sequence[Sample]) -> None:
        if samples:
            self._sink.samples(samples)

    def call_began(self) -> None:
        """Notes a telephone call."""
        self.record.telephone().connect(_now())

    def call_ended(self) -> None:
        """Notes the end of a telephone call."""
        record = self.record.telephone()
        record.enter(CallState.IDLE, _now())
        record.count(COMPLETE)  # the caller knows if it is
        for station in self.stations.values():
            if station.call_ended():
                self._sink.online(station, False)

    def ended(self) -> None:
        """Notes that the port is lost."""
        self._lost = True
        self._wake.set()


def _now() -> float:
    return asyncio.get_running_loop().time()
