"""A door while the gateway runs: its port, and the programs that are connected."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, TypeVar

import structlog

from gateway.config import Config
from gateway.contract import payload
from gateway.contract.documents.requests import OutcomeDocument
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import LineDown
from gateway.line.line import Line
from gateway.line.opening import Pauses
from gateway.parts.doors.documents import DoorDocument
from gateway.parts.doors.guest import Guest
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.repeated_reads import RepeatedReads
from gateway.parts.doors.settings import ALONE, Door
from gateway.parts.doors.tunnel import Tunnel
from gateway.plant.plant import Plant
from gateway.stations.served.answering import Answerer, Answering, Wire
from gateway.stations.served.echo import Echo
from gateway.stations.served.registry import answerer, is_numbered
from gateway.stations.store import Store
from gateway.tags.timestamps import rfc3339
from gateway.transport import Port
from gateway.transport.listen import Listener
from gateway.transport.port import SerialSettings, TcpAddress, allows
from gateway.transport.terminal import Terminal
from gateway.transport.tls import certificate_of

log = structlog.get_logger("gateway.line")
T = TypeVar("T")
Audit = Callable[[int, str], None]
HELD = 60.0  # seconds: a program that was sent away connects again by itself


class OpenDoor:
    """The task of one door. The listener bounds the number of its programs."""

    def __init__(
        self,
        settings: Door,
        turns: GuestRequests,
        plant: Plant,
        tasks: asyncio.TaskGroup,
        audit: Audit,
    ) -> None:
        self.settings = settings
        self.turns = turns
        self._audit = audit
        self.reads = RepeatedReads()
        self.guests: set[Guest | Tunnel] = set()
        self.devices: Mapping[int, DeviceSettings] = {}  # by station
        self.line: Line | None = None  # while all its devices belong to other gateways
        self.serial = SerialSettings()
        self._place(plant.config, plant)
        self._duty = plant.duty
        self._tasks = tasks
        self._trouble = ""
        self._turned_away = 0
        self._held_until = 0.0  # by the loop's clock: after a release no program gets the wire

    def _place(self, config: Config, plant: Plant) -> None:
        lines = {line.name: line for line in plant.lines}
        self.line, self.devices = lines.get(self.settings.line), {}
        for line in config.lines:
            if line.name == self.settings.line and self.line is not None:
                self.devices, self.serial = self.settings.stations(config), line.serial

    @property
    def trouble(self) -> str:
        """Why no program is served; empty: it is open."""
        elsewhere = f"other gateways have the devices of line {self.settings.line}"
        return self._trouble or (elsewhere if self.line is None else "")

    @property
    def numbered(self) -> bool:
        """A reply has the number of its request, so it is never taken for another one."""
        return is_numbered(self.settings.protocol)

    async def run(self) -> None:
        """Serves until cancelled."""
        pauses = Pauses(self.settings.name)
        while True:
            where = self.settings.where
            listener = Listener(where) if isinstance(where, TcpAddress) else Terminal(where)
            try:
                await listener.open()
                log.info("door open", door=self.settings.name, line=self.settings.line)
                self._trouble = ""
                pauses.restart()
                await listener.serve(self.connect)
            except LineDown as error:
                if self._trouble != str(error):
                    log.warning("door closed", door=self.settings.name, why=str(error))
                self._trouble = str(error)
            finally:
                await listener.close()
            await asyncio.sleep(pauses.take())

    def connect(self, address: str) -> Guest | Tunnel | None:
        raw, networks, line = self.settings.protocol in ALONE, self.settings.networks, self.line
        held = raw and (self.guests or asyncio.get_running_loop().time() < self._held_until)
        if held or line is None or (networks and not allows(networks, address)):
            self.turn_away(address)
            return None
        return Tunnel(self, line, address) if raw else Guest(self, line, address)

    def turn_away(self, address: str) -> None:
        """Counts a program that is not served."""
        self._turned_away += 1
        log.debug("turned away", door=self.settings.name, address=address)

    def start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        return self._tasks.create_task(work)

    def why_not(self, now: float) -> str:
        """Returns the reason to answer nothing now; empty: none."""
        return self._duty.why_not(now, now)

    def may_write(self, port: Port) -> bool:
        """Returns False for a program whose certificate has no role that may write."""
        if self.settings.tls is None:
            return True
        from gateway.contract.access.certificates import may_write  # its TLS takes 10 ms

        return may_write(self.settings.tls, certificate_of(port))

    def machine(self, line: Line, stores: Mapping[int, Store]) -> Answerer:
        """Returns an answering machine over these stores, by station number."""
        stations = {
            number: Answering(self.devices[number].driver, store)
            for number, store in stores.items()
        }
        wire = Wire(character=line.engine.wire.character, echo=Echo(told=False))
        return answerer(self.settings.protocol, stations, wire)

    def take_over(self, config: Config, plant: Plant) -> None:
        """Takes over a changed file. Programs connect again if their devices are others now."""
        devices, line = self.devices, self.line
        self._place(config, plant)
        if devices != self.devices or line is not self.line:
            for guest in [*self.guests]:
                guest.leave()

    def release(self, by: str) -> None:
        """Disconnects the programs. A raw door takes none for a minute."""
        self.tell(f"doors/{self.settings.name}", by, 0.0, f"released; {len(self.guests)} connected")
        self._held_until = asyncio.get_running_loop().time() + HELD
        for guest in [*self.guests]:
            guest.leave(f"released by {by}")

    def tell(self, key: str, by: str, took: float, answer: str) -> None:
        """Has the audit and the log keep something that was done."""
        now = time.time_ns()
        log.warning(
            "door used", door=self.settings.name, line=self.settings.line, by=by, what=answer
        )
        event: OutcomeDocument = {
            "key": key,
            "value": None,
            "time": rfc3339(now),
            "took": round(took, 3),
            "by": by,
            "outcome": "obeyed",
            "answer": answer,
        }
        self._audit(now, payload.document(event).decode())

    def document(self, now: float) -> DoorDocument:
        settings = self.settings
        return {
            "line": settings.line,
            "listen": settings.listens,
            "protocol": settings.protocol,
            "trouble": self.trouble,
            "most": settings.most,
            "share": round(self.turns.share(now), 4),
            "turned_away": self._turned_away,
            "programs": [guest.document(now) for guest in [*self.guests]],
            "reads": self.reads.documents({one.name: one for one in self.devices.values()}),
        }
