"""Bulkheads: each part of the service works in one, so that its failure ends nothing else.

What a part raises is logged once with its trace, shown in the status as a fault, and after a pause
the part is made again. The pause grows as long as the part goes on failing.
"""

import asyncio
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from types import TracebackType
from typing import Any, TypeVar

import structlog

from gateway.config import Config
from gateway.contract.documents.state import FaultDocument, PartDocument
from gateway.contract.interfaces import History, Keyed, North
from gateway.contract.line_faults import Fault
from gateway.errors import Busy, GatewayError
from gateway.plant.part import (
    Activates,
    Audits,
    Begins,
    Core,
    Documented,
    Faulty,
    Follows,
    Kind,
    LoadedFile,
    Logged,
    Part,
    Phase,
    Remembers,
    Republishes,
    Restores,
    Retags,
    Sees,
    Stores,
    TakesOver,
    nothing,
)
from gateway.plant.plant import Plant
from gateway.tags import Sample, Tag

log = structlog.get_logger("gateway")

PAUSE_FIRST, PAUSE_LONGEST = 5.0, 300.0  # seconds
WORKED = 600.0  # seconds: a part that worked so long begins with the first pause again
CALL_WITHIN = 5.0  # seconds for what the plant waits for: `restore`, `begin`, `take_over` …
END_WITHIN = 1.0  # seconds

T = TypeVar("T")


class Bulkhead:
    """One part: made, run, and made again after a failure. Belongs to the event loop.

    `with bulkhead:` takes every error of the part. Only the first `make` raises `ConfigError`: the
    gateway does not start with a mistake in its file.
    """

    def __init__(self, name: str, kind: Kind, core: Core, changed: Callable[[], None]) -> None:
        """`changed`: called when there is another part, or none."""
        self.name = name
        self.kind = kind
        self.part: Part | None = None
        self.why = ""  # it does not work; empty: it works, or the file does not want it
        self.failures = 0
        self._core = core
        self._changed = changed
        self._pause = PAUSE_FIRST
        self._since = self._again_at = 0.0  # by the loop's clock
        self._work: asyncio.Task[None] | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._activated: Part | None = None
        self.part = kind.make(core)

    # -- the one place for the errors of parts --

    def __enter__(self) -> None:
        """Begins a call of the part."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        self._fail(error)
        return True

    def _fail(self, error: Exception) -> None:
        self.part = None
        self.failures += 1
        why = f"{type(error).__name__}: {error}"
        log.error("part stopped", part=self.name, why=why, exc_info=error)
        self.why = why
        if self._work is not None:
            self._work.cancel()
        self._changed()

    # -- life --

    def _make(self) -> None:
        with self:
            self.part = self.kind.make(self._core)
            self.why = ""
        self._changed()

    def activate(self, *, active: bool) -> None:
        """Tells the part once that the gateway is active."""
        part = self.part
        if active and isinstance(part, Activates) and part is not self._activated:
            self._activated = part
            with self:
                part.activate()

    async def call(
        self, capability: type[Any], use: Callable[[Any], Coroutine[Any, Any, None]]
    ) -> None:
        """Has the part use a capability, if it has it, within `CALL_WITHIN`."""
        part = self.part
        if isinstance(part, capability):
            with self:
                try:
                    async with asyncio.timeout(CALL_WITHIN):
                        await use(part)
                except TimeoutError:
                    raise GatewayError(f"it did not answer within {CALL_WITHIN:g} s") from None

    def start(self) -> None:
        """Runs the part until `stop`."""
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep(), name=f"keeper of {self.name}")

    async def _keep(self) -> None:
        while True:
            if self.part is None and self.why:
                self._make()
                await self.call(Begins, lambda part: part.begin())
            if self.part is None and not self.why:
                return  # the file does not want it
            if self.part is not None:
                self._since = asyncio.get_running_loop().time()
                await self._run(self.part)
                if asyncio.get_running_loop().time() - self._since > WORKED:
                    self._pause = PAUSE_FIRST
            self._again_at = asyncio.get_running_loop().time() + self._pause
            await asyncio.sleep(self._pause)
            self._pause = min(2 * self._pause, PAUSE_LONGEST)

    async def _run(self, part: Part) -> None:
        """Returns when the part has failed."""
        self._work = work = asyncio.create_task(part.run(), name=self.name)
        try:
            await asyncio.wait([work])
        finally:
            self._work = None
            work.cancel()
            await asyncio.wait([work])
        if self.part is part:
            with self:
                work.result()
                raise GatewayError("it ended by itself")

    async def stop(self, within: float = END_WITHIN) -> None:
        """Ends the part. What it does not close in time is left."""
        if self._keeper is None:
            return
        self._keeper.cancel()
        _, pending = await asyncio.wait([self._keeper], timeout=max(0.0, within))
        if pending:
            log.error("part close timed out", part=self.name)

    def working(self, capability: type[Any]) -> Any:
        """Returns the part. Raises `Busy` while it does not work."""
        if not isinstance(self.part, capability):
            raise Busy(f"{self.name} stopped: {self.why}")
        return self.part

    def document(self) -> PartDocument:
        """`again`: seconds until a stopped part is tried again."""
        again, faults = None, list[Fault]()
        if isinstance(self.part, Faulty):
            with self:
                faults += self.part.faults()
        if self.why:
            now = asyncio.get_running_loop().time()
            again = max(0, round(self._again_at - now))
        told: list[FaultDocument] = [{"code": one.code, "text": one.text} for one in faults]
        return {"why": self.why, "again": again, "failures": self.failures, "faults": told}


class Bulkheads:
    """All parts of the service, in the order of their start."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._all: list[Bulkhead] = []
        self._followers: Sequence[tuple[Bulkhead, Follows]] = ()
        self._auditors: Sequence[tuple[Bulkhead, Audits]] = ()
        self._active = False
        plant.doors.retagged = self._retag
        plant.doors.documents.append(self.documents)

    def make(
        self,
        kinds: Iterable[tuple[str, Kind]],
        north: North,
        start_over: Callable[[str], None] = nothing,
        file: LoadedFile | None = None,
    ) -> None:
        """Makes the parts. Raises `ConfigError` for a mistake that only a part finds."""
        core = Core(self._plant, north, self.history, self, start_over, file)
        for name, kind in kinds:
            self._all.append(Bulkhead(name, kind, core, self._changed))
        self._changed()

    # -- for Zenoh and other parts --

    def each(self, capability: type[Any]) -> Sequence[Any]:
        return [part for _, part in self._having(capability)]

    def _having(self, capability: type[Any]) -> list[tuple[Bulkhead, Any]]:
        return [(one, one.part) for one in self._all if isinstance(one.part, capability)]

    def has_keys(self, part: str) -> bool:
        return any(
            one.name == part and one.kind.serves is Keyed and (one.part is not None or one.why)
            for one in self._all
        )

    def keyed(self, part: str) -> Keyed:
        for one in self._all:
            if one.name == part and one.kind.serves is Keyed:
                found: Keyed = one.working(Keyed)
                return found
        raise Busy(f"there is no {part} here")

    def history(self) -> History | None:
        for one in self._all:
            if one.kind.serves is Remembers and (one.part is not None or one.why):
                found: Remembers = one.working(Remembers)
                return found.history
        return None

    def audit(self, at: int, event: str) -> None:
        for one, part in self._auditors:
            with one:
                part.audit(at, event)

    async def publish_all(self) -> None:
        for one in self._all:
            await one.call(Republishes, lambda part: part.publish_all())

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        found: dict[str, Mapping[str, object]] = {}
        for one, part in self._having(Documented):
            with one:
                found |= part.documents()
        for one in self._all:
            if one.part is not None or one.why:
                found[f"parts/{one.name}"] = one.document()
        return found

    # -- from the plant --

    def publish(self, samples: Sequence[Sample]) -> None:
        for one, part in self._followers:
            with one:
                part.publish(samples)

    def set_online(self, device: str, online: bool) -> None:
        for one, part in self._followers:
            with one:
                part.set_online(device, online)

    def _retag(self, tags: Sequence[Tag], gone: Sequence[Tag]) -> None:
        for one, part in self._having(Retags):
            with one:
                part.retag(tags, gone)
        self._changed()

    def _changed(self) -> None:
        """Notes which parts see samples and writes now."""
        self._followers, self._auditors = self._having(Follows), self._having(Audits)
        self._plant.doors.stores[:] = self.each(Stores)
        self._plant.doors.logs[:] = [part.wire_logs for part in self.each(Logged)]
        for one in self._all:
            one.activate(active=self._active)
        seers = list[Callable[[Sequence[Sample]], None]]()
        for one, part in self._having(Sees):
            with one:
                if part.wants:
                    seers.append(_guarded(one, part.seen))
        self._plant.doors.seers = seers

    # -- life --

    async def restore(self) -> None:
        """Call it before the lines are planned."""
        for one in self._all:
            await one.call(Restores, lambda part: part.restore())

    async def start(self, *phases: Phase) -> None:
        """Starts the parts of these phases."""
        for one in self._all:
            if one.kind.phase in phases:
                await one.call(Begins, lambda part: part.begin())
                one.start()

    def activate(self) -> None:
        """Call it when this gateway is active, before its lines begin."""
        self._active = True
        self._changed()

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        for one in self._all:
            await one.call(TakesOver, lambda part: part.take_over(config, renewed))
        self._changed()

    async def stop(self, *phases: Phase, within: float = END_WITHIN) -> None:
        """Ends the parts of these phases, all at once."""
        ends = [one.stop(within) for one in self._all if one.kind.phase in phases]
        await asyncio.gather(*ends)


def _guarded(
    bulkhead: Bulkhead, seen: Callable[[Sequence[Sample]], None]
) -> Callable[[Sequence[Sample]], None]:
    def guarded(samples: Sequence[Sample]) -> None:
        with bulkhead:
            seen(samples)

    return guarded
