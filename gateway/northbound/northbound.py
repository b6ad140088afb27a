"""The gateway as Zenoh sees it: values out, questions answered, writes taken, signs of life."""

import asyncio
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict

import structlog
import zenoh

from gateway import payload
from gateway.errors import GatewayError
from gateway.keys import Keys
from gateway.northbound.directory import Directory
from gateway.northbound.inbox import Inbox
from gateway.northbound.plant import History, Plant
from gateway.northbound.publisher import Publisher
from gateway.northbound.queries import Queries
from gateway.northbound.replies import Replies
from gateway.northbound.session import (
    CLOSE_WITHIN,
    Mode,
    ZenohSettings,
    configure,
    off_loop,
    opened,
)
from gateway.northbound.writes import PutWrites, Writes
from gateway.payload import Failure, Problem, WriteOutcome
from gateway.tags import Sample, Written

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

STATUS_EVERY = 5.0  # seconds
# After a link returned: first its declarations arrive, and only then does a put reach anyone.
_SETTLE = 0.3
# A router that was restarted gets its other clients back later than us: once more for them.
_LATECOMERS = 5.0
_REMEMBERED = 256  # lost links
_REPUBLISH_AT_ONCE = 500  # samples in one turn of the loop
_PATIENCE = 0.5  # seconds for what still waits to be put when the gateway ends


class Northbound:
    """One Zenoh session and what is declared on it. Every method belongs to the event loop.

    Raises `ConfigError` when made with a bad prefix, name, endpoint or Zenoh file.
    """

    def __init__(
        self,
        settings: ZenohSettings,
        name: str,
        plant: Plant,
        *,
        history: History | None = None,
        status_every: float = STATUS_EVERY,
    ) -> None:
        self.keys = Keys(settings.prefix, name)
        self.opened = asyncio.Event()  # everything is declared, all current values are queued
        self._config = configure(settings)
        self._retry = settings.mode is Mode.CLIENT
        self._plant = plant
        self._history = history
        self._status_every = status_every
        self._publisher = Publisher(self.keys)
        self._directory = Directory(self.keys, ())
        self._declared: list[object] = []
        self._queries: Queries | None = None
        self._with_blocks: frozenset[str] = frozenset()
        self._links: dict[str, str] = {}  # what is at the other end, by its id
        self._lost: dict[str, None] = {}  # the ids of links that went, oldest first
        self._returned = asyncio.Event()
        self._puts: PutWrites | None = None
        self._documents: tuple[float, dict[str, bytes]] = (float("-inf"), {})

    # -- from the gateway --

    def publish(self, samples: Sequence[Sample]) -> None:
        """Sends samples out, and per device with blocks all of them in one. Never blocks.

        One call is one scan. The plant's own samples must be updated before.
        """
        self._publisher.values(samples)
        if not self._with_blocks:
            return
        scans: dict[str, list[Sample]] = {}
        for sample in samples:
            if sample.tag.device in self._with_blocks:
                scans.setdefault(sample.tag.device, []).append(sample)
        for device, changed in scans.items():
            self._publisher.block(device, changed)

    def publish_events(self, samples: Iterable[Sample]) -> None:
        """Sends out every sample in order, none replaced by the next. Never blocks."""
        self._publisher.events(samples)

    def alive(self, device: str, alive: bool) -> None:
        """Whether the device answers: its liveliness token."""
        self._publisher.alive(device, alive)

    def wrote(self, outcome: WriteOutcome) -> None:
        """Tells log and network how a write ended."""
        match outcome.result:
            case Written(verified=verified):
                log.info(
                    "written",
                    key=outcome.key,
                    value=outcome.value,
                    verified=verified,
                    took=round(outcome.took, 4),
                    by=outcome.by,
                )
            case Failure(problem=Problem.BUSY):
                log.debug("not written: busy", key=outcome.key, by=outcome.by)
            case failed:
                log.warning(
                    "perhaps written" if failed.problem is Problem.UNCLEAR else "not written",
                    key=outcome.key,
                    value=outcome.value,
                    error=failed.problem.value,
                    code=failed.code,
                    reason=failed.reason,
                    by=outcome.by,
                )
        self._publisher.document(self.keys.writes, payload.write_outcome(outcome))

    def counters(self) -> dict[str, int]:
        """What went out, came in and was dropped since the start."""
        counted = asdict(self._publisher.counters)
        if self._queries is not None:
            counted |= asdict(self._queries.counters)
        if self._puts is not None:
            counted["puts_refused"] = self._puts.refused
        return counted | {"links": len(self._links)}

    # -- life --

    async def run(self) -> None:
        """Serves until cancelled; the session is closed whatever happens, within 2 s.

        Once only: for another session make another `Northbound`. Raises `GatewayError` when the
        session cannot be opened (a client waits for its router), and an `ExceptionGroup` with
        whatever ended it later.
        """
        session = await opened(self._config, retry=self._retry)
        try:
            await self._serve(session)
        finally:
            closing = asyncio.ensure_future(self._close(session))
            try:
                await asyncio.shield(closing)
            except asyncio.CancelledError:
                await asyncio.wait([closing])  # no hurry ends this half done
                raise

    async def _serve(self, session: zenoh.Session) -> None:
        devices = list(self._plant.devices())
        self._directory = Directory(self.keys, devices)
        self._with_blocks = frozenset(device.name for device in devices if device.blocks)
        writes = Writes(self.keys, self._plant, self._directory, self.wrote)
        replies = Replies(
            self.keys, self._plant, self._directory, session.new_timestamp, self._history
        )
        self._queries = Queries(self._plant, self._directory, writes, replies, self._status)
        queries = Inbox(self._queries.take, self._queries.refuse)
        self._puts = PutWrites(writes, self._directory)
        puts = Inbox(self._puts.take, self._puts.refuse)
        links = Inbox(self._link, lambda _: None)
        # Kept, for what is forgotten is undeclared.
        self._declared = await off_loop(self._declare, session, queries, puts, links)
        self._publisher.start(session)
        await self._publish_all()
        self._publish_status()
        self.opened.set()
        log.info("on Zenoh", prefix=self.keys.prefix, id=str(session.zid()))
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._tell_status())
            tasks.create_task(self._republish())
            tasks.create_task(self._watch())

    def _declare(
        self,
        session: zenoh.Session,
        queries: Inbox[zenoh.Query],
        puts: Inbox[zenoh.Sample],
        links: Inbox[zenoh.TransportEvent],
    ) -> list[object]:
        """Everything that others find of us. They live as long as the session.

        Values are not `complete`: others may share the prefix, and all are to be asked. A device
        has one gateway, and its writes go to one queryable, however many would take them.
        """
        # Directly on Zenoh's receiving thread: an inbox only appends, and a thread for each
        # declaration would be needed otherwise.
        ask = zenoh.handlers.Callback(queries, indirect=False)
        mine = self._directory.devices
        shared = (self.keys.values, self.keys.late, self.keys.metas, self.keys.statuses)
        blocks = (self.keys.blocks,) if self._with_blocks else ()
        return [
            session.info.declare_transport_events_listener(
                zenoh.handlers.Callback(links, indirect=False), history=True
            ),
            *(session.declare_queryable(key, ask, complete=False) for key in (*shared, *blocks)),
            *(
                session.declare_queryable(self.keys.sets(device.name), ask, complete=True)
                for device in mine
            ),
            session.declare_subscriber(
                f"{self.keys.values}/@set",
                zenoh.handlers.Callback(puts, indirect=False),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
            # Last: whoever sees it may ask at once.
            session.liveliness().declare_token(self.keys.own),
        ]

    async def _close(self, session: zenoh.Session) -> None:
        if self._puts is not None:
            self._puts.close()
        if self._queries is not None:
            await self._queries.close()
        try:
            async with asyncio.timeout(CLOSE_WITHIN - 2 * _PATIENCE):
                await off_loop(self._shut, session)
        except TimeoutError:
            log.warning("the Zenoh session did not close in time")
        if self._queries is not None:
            self._queries.end()

    def _shut(self, session: zenoh.Session) -> None:
        self._publisher.stop(_PATIENCE)
        session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it

    # -- going out by itself --

    async def _publish_all(self) -> None:
        tags = self._directory.all()
        for start in range(0, len(tags), _REPUBLISH_AT_ONCE):
            chunk = tags[start : start + _REPUBLISH_AT_ONCE]
            self._publisher.values(self._plant.sample(tag) for tag in chunk)
            await asyncio.sleep(0)

    async def _republish(self) -> None:
        """All current values again after each return to the network."""
        while True:
            await self._returned.wait()
            await asyncio.sleep(_SETTLE)
            self._returned.clear()
            await self._publish_all()
            with suppress(TimeoutError):
                async with asyncio.timeout(_LATECOMERS):
                    await self._returned.wait()
                    continue
            await self._publish_all()

    async def _watch(self) -> None:
        await self._publisher.ended.wait()
        raise GatewayError("the publishing thread has ended: nothing would be published any more")

    async def _tell_status(self) -> None:
        while True:
            await asyncio.sleep(self._status_every)
            self._publish_status()

    def _publish_status(self) -> None:
        for key, document in self._status().items():
            self._publisher.document(key, document)

    def _status(self) -> dict[str, bytes]:
        """Every status document by its key; at most a fifth of a second old, however many ask."""
        made, documents = self._documents
        now = time.monotonic()
        if now - made > 0.2:
            own = {"zenoh": {**self.counters(), "to": sorted(self._links.values())}}
            documents = {
                self.keys.status(path): payload.document(fields)
                for path, fields in {**self._plant.status(), **own}.items()
            }
            self._documents = (now, documents)
        return documents

    # -- coming in --

    def _link(self, event: zenoh.TransportEvent) -> None:
        """A router that appears, and whoever was here before, may have missed something."""
        there, what = str(event.transport.zid), str(event.transport.whatami)
        if event.kind == zenoh.SampleKind.DELETE:
            self._links.pop(there, None)
            self._lost[there] = None
            if len(self._lost) > _REMEMBERED:
                del self._lost[next(iter(self._lost))]
            log.info("Zenoh link down", to=what, id=there)
            return
        self._links[there] = what
        log.info("Zenoh link up", to=what, id=there)
        if what == "router" or there in self._lost:
            self._lost.pop(there, None)
            self._returned.set()
