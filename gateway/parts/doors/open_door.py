"""A door while the gateway runs: its port, and the programs that are connected."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, TypeVar

import structlog

from gateway.config import Config
from gateway.contract.documents.state import DoorDocument
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import LineDown
from gateway.line.line import Line
from gateway.line.opening import Pauses
from gateway.parts.doors.guest import Guest
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.settings import RAW, Door
from gateway.parts.doors.tunnel import Tunnel
from gateway.plant.plant import Plant
from gateway.stations.served.answering import Answerer, Answering, Wire
from gateway.stations.served.echo import Echo
from gateway.stations.served.registry import answerer, is_numbered
from gateway.stations.store import Store
from gateway.transport.listen import Listener
from gateway.transport.port import allows, named

log = structlog.get_logger("gateway.line")
T = TypeVar("T")
Audit = Callable[[int, str], None]


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
        self.audit = audit
        self.line = self._line(plant)
        self.guests: set[Guest | Tunnel] = set()
        self.devices: Mapping[int, DeviceSettings] = settings.stations(plant.config)  # by station
        self._duty = plant.duty
        self._tasks = tasks
        self._trouble = ""
        self._turned_away = 0

    def _line(self, plant: Plant) -> Line:
        return next(one for one in plant.lines if one.name == self.settings.line)

    @property
    def numbered(self) -> bool:
        """A reply has the number of its request, so it is never taken for another one."""
        return is_numbered(self.settings.protocol)

    async def run(self) -> None:
        """Serves until cancelled."""
        pauses = Pauses(self.settings.name)
        while True:
            listener = Listener(self.settings.where)
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
        raw = self.settings.protocol == RAW
        if not allows(self.settings.networks, address) or (raw and self.guests):
            self._turned_away += 1
            log.debug("turned away", door=self.settings.name, address=address)
            return None
        return Tunnel(self, address) if raw else Guest(self, address)

    def start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        return self._tasks.create_task(work)

    def why_not(self, now: float) -> str:
        """Returns the reason to answer nothing now; empty: none."""
        return self._duty.why_not(now, now)

    def machine(self, stores: Mapping[int, Store]) -> Answerer:
        """Returns an answering machine over these stores, by station number."""
        stations = {
            number: Answering(self.devices[number].driver, store)
            for number, store in stores.items()
        }
        wire = Wire(character=self.line.engine.wire.character, echo=Echo(told=False))
        return answerer(self.settings.protocol, stations, wire)

    def take_over(self, config: Config, plant: Plant) -> None:
        """Takes over a changed file. Programs connect again if their devices are others now."""
        devices, line = self.settings.stations(config), self._line(plant)
        if devices != self.devices or line is not self.line:
            self.devices, self.line = devices, line
            for guest in [*self.guests]:
                guest.leave()

    def document(self, now: float) -> DoorDocument:
        settings = self.settings
        return {
            "line": settings.line,
            "listen": named(settings.where.host, settings.where.port),
            "protocol": settings.protocol,
            "trouble": self._trouble,
            "most": settings.most,
            "share": round(self.turns.share(now), 4),
            "turned_away": self._turned_away,
            "programs": [guest.document(now) for guest in self.guests],
        }
