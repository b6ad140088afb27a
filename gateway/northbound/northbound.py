"""The Zenoh side of the gateway: one session, its declarations, and their life."""

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import structlog
import zenoh

from gateway.config import Config, ZenohConfig, ZenohMode
from gateway.contract.access import secrets
from gateway.contract.access.writers import Writers
from gateway.contract.interfaces import Parts, Plant
from gateway.contract.keys import Keys
from gateway.contract.payload import GroupResult
from gateway.contract.problems import Failure
from gateway.contract.report import report
from gateway.errors import Busy, GatewayError
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.group.admission import Admission
from gateway.northbound.group.standby import GroupSettings
from gateway.northbound.publishing.publisher import Publisher
from gateway.northbound.publishing.republish import Republisher
from gateway.northbound.publishing.scan_batches import ScanBatches
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.northbound.publishing.status_publisher import StatusPublisher
from gateway.northbound.publishing.traces import Traces
from gateway.northbound.requests.acceptance import Acceptance, AcceptedUntil
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.inbox import Inbox
from gateway.northbound.requests.incoming import Declarations, Incoming
from gateway.northbound.session import exposures
from gateway.northbound.session.everywhere import everywhere
from gateway.northbound.session.link_monitor import LinkMonitor
from gateway.northbound.session.one_process import only_process
from gateway.northbound.session.session import CLOSE_WITHIN, forget_dead_routes, open_session
from gateway.northbound.session.session_settings import configure, drop_limit, endpoints
from gateway.northbound.session.watchdog import Watchdog
from gateway.plant.threads import off_loop
from gateway.tags import Sample, Tag, WriteResult
from gateway.values import Value

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

STATUS_EVERY = 5.0  # seconds
_ROUTERS_EVERY = 1.0  # seconds between two lost routers that count
_REPORTS_WITHIN = 5.0  # seconds for a gateway that hangs
_FLUSH_TIMEOUT = 0.5  # seconds for waiting puts when the gateway ends


class Files(NamedTuple):
    """Files of one gateway."""

    writers: Path | None = None  # who may write; without it every client that Zenoh admits
    writers_state: Path | None = None  # until when their signatures were accepted
    folder: Path | None = None  # of what the gateway writes; only one process runs with it


NO_FILES = Files()


class Northbound:
    """One Zenoh session and its declarations. Every method belongs to the event loop.

    Four events report its progress to the service:

    * `exclusive`: no other process runs this gateway; files and lines may be opened.
    * `active`: this gateway may open its lines.
    * `opened`: everything is declared, and all current values are queued.
    * `replaced`: another gateway is active, or serves one of the devices, or the event loop stood
      still. Close the lines, end this, and start another `Northbound` that does `withhold` the
      devices `withheld` here.

    Raises `ConfigError` for a bad prefix, name, endpoint, Zenoh file or writers file, and for a
    secret that every user of this machine could read.
    """

    def __init__(
        self,
        settings: ZenohConfig,
        name: str,
        plant: Plant,
        *,
        parts: Parts,
        files: Files = NO_FILES,
        group: GroupSettings | None = None,
        status_every: float = STATUS_EVERY,
    ) -> None:
        self.keys = Keys(settings.prefix, name)
        self.exclusive = asyncio.Event()
        self.opened = asyncio.Event()
        self._config = configure(settings)
        self._folder = files.folder
        group = group or GroupSettings()
        accepted = None if files.writers_state is None else AcceptedUntil(files.writers_state)
        floor = 0.0 if accepted is None else accepted.floor
        writers = None if files.writers is None else Writers(files.writers, floor)
        for exposure in _exposures(self._config, files.writers, group):
            log.warning("Zenoh session exposed", why=exposure)
        self._plant = plant
        self._links = LinkMonitor(is_peer=settings.mode is ZenohMode.PEER)
        index = TagIndex(self.keys, plant.devices(), plant.tag)
        self.admission = Admission(group, self.keys, self._config, index.names, plant.duty)
        losses = SlowPuts(drop_limit(self._config))
        self._publisher = Publisher(losses, index)
        self._batches = ScanBatches(self._publisher, index)
        self._republisher = Republisher(
            self._batches.publish,
            plant,
            index,
            self._links,
            losses,
            settings.refresh,
            parts.publish_all,
        )
        self._parts = parts
        audit = Audit(partial(self._publisher.document, self.keys.writes), self._record)
        self._status = StatusPublisher(
            self.keys, self._collect_status, self._publisher, audit, status_every
        )
        self._incoming = Incoming(
            self.keys,
            plant,
            index,
            audit,
            self._status.documents,
            parts,
            Acceptance(plant.duty, writers, accepted=accepted),
        )
        self._declared: list[object] = []  # Zenoh undeclares an object without a reference

    # -- from the gateway --

    def publish(self, samples: Sequence[Sample]) -> None:
        """Publishes one scan. Never blocks. The plant updates its own samples first. Samples of
        event tags all go out, in order, none replaced by the next."""
        self._batches.publish(samples)

    def set_online(self, device: str, online: bool) -> None:
        """Declares or undeclares the device's liveliness token."""
        self._publisher.set_online(device, online)

    def counters(self) -> dict[str, int]:
        """Messages out, in and dropped since the start."""
        outgoing = self._publisher.counts() | {"links": len(self._links)}
        return outgoing | self._incoming.counters()

    async def documents(self, max_age: float) -> Mapping[str, Mapping[str, object]]:
        """Returns the status documents by path, at most `max_age` seconds old."""
        return await self._status.fields(max_age)

    def reports(self) -> Iterable[tuple[str, bytes, float]]:
        """Asks all gateways under the prefix, as `North.reports`."""
        if (session := self._publisher.session) is None:
            raise GatewayError("the Zenoh session is not open")
        return everywhere(session, self.keys, "report", _REPORTS_WITHIN)

    async def write(
        self, tag: str, data: bytes, by: str, arrived: float
    ) -> WriteResult | Failure | GroupResult:
        """Writes for the client `by`, whom another part of the gateway has admitted; `tag`:
        `device/name`; `data`: the payload as on Zenoh; `arrived`: by the loop's clock."""
        return await self._incoming.write(tag, data, by, arrived)

    async def order(
        self, part: str, path: str, data: bytes, by: str, arrived: float
    ) -> bytes | Failure:
        """Has a part carry out an order of the client `by`, as `write` does."""
        return await self._incoming.order(part, path, data, by, arrived)

    def publish_latest(self, path: str, make: Callable[[], bytes]) -> None:
        """Publishes a document of a part. Never blocks: the publishing thread makes it."""
        self._publisher.latest(self.keys.status(path), make)

    async def write_own(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> WriteResult:
        """Writes for a part named `by`, as `OwnWrites.write`."""
        return await self._incoming.own_writes.write(tag, value, by, within, repeated=repeated)

    def deny_own(self, tag: Tag, value: Value | None, by: str, why: str) -> None:
        """Audits a write of a part, as `OwnWrites.deny`."""
        self._incoming.own_writes.deny(tag, value, by, why)

    @property
    def is_ready(self) -> bool:
        """True when the gateway serves its plant."""
        return self.opened.is_set()

    async def change(self, index: TagIndex) -> None:
        """Serves the devices of the plant as they are now."""
        self._publisher.forget(self._incoming.become(index))
        if self.opened.is_set():
            await off_loop(self._incoming.changed)
            self._status.publish()

    # -- life --

    async def run(self) -> None:
        """Serves until cancelled; closes the session in every case, within 2 s.

        Call it once only: another session needs another `Northbound`. Raises `GatewayError` when
        the session cannot be opened (a client waits for its router) or this gateway has another
        process, and an `ExceptionGroup` with a later failure. The open session sets `exclusive`: a
        second process with the same endpoint fails here.
        """
        places = (self._config.get_json(f"{side}/endpoints") for side in ("listen", "connect"))
        with only_process(self._folder, self.keys.own, *places):
            await self._run()

    async def _run(self) -> None:
        is_client = self._config.get_json("mode") == f'"{ZenohMode.CLIENT.value}"'
        if is_client:
            self.exclusive.set()  # it takes no endpoint, and may wait for its router for ever
        alone = asyncio.create_task(self.admission.run_alone())
        try:
            session = await open_session(self._config, retry=is_client)
        finally:
            alone.cancel()
        self.exclusive.set()
        try:
            await self._serve_watched(session)
        finally:
            closing = asyncio.ensure_future(self._close(session))
            try:
                await asyncio.shield(closing)
            except asyncio.CancelledError:
                await asyncio.wait([closing])  # a second cancellation must not leave it half closed
                raise

    async def _serve_watched(self, session: zenoh.Session) -> None:
        replaced = self.admission.replaced.set
        watchdog = Watchdog(lambda: [session, *self.admission.sessions()], replaced)
        with watchdog.watching():
            try:
                await self._serve(session)
            except* (GatewayError, zenoh.ZError):
                if not watchdog.has_fired:
                    raise
                replaced()

    async def _serve(self, session: zenoh.Session) -> None:
        self._publisher.start(session)
        declarations = self._incoming.start(session)
        links = Inbox(self._links.take, lambda _: None)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch_publisher())
            self._declared = await off_loop(self._declare_first, session, declarations, links)
            tasks.create_task(self.admission.run(session))
            tasks.create_task(self._status.run())
            tasks.create_task(self._after_lost_routers())
            await self.admission.active.wait()
            self._plant.begin()
            self._incoming.begin()
            await off_loop(self._declare_plant, declarations)
            traces = Traces(self.keys, self._plant, self._publisher.document)
            self._declared += await off_loop(traces.declare, session, traces.inbox())
            if len(self._links):  # else nothing would arrive; each link has all published
                await self._republisher.publish_all()
            else:
                await self._parts.publish_all()
            self._status.publish()
            self.opened.set()
            await off_loop(self._incoming.changed)  # a reload came between
            log.info("Zenoh session ready", prefix=self.keys.prefix, id=str(session.zid()))
            tasks.create_task(self._republisher.run())
            tasks.create_task(self.admission.claiming.notice_answers(session, self._some_key))

    def _some_key(self) -> str | None:
        """Returns the key of a value of this gateway; None: it has none."""
        tags = (tag for device in self._plant.devices() for tag in device.tags)
        return next((self.keys.value(tag.key) for tag in tags), None)

    async def _after_lost_routers(self) -> None:
        lost = self._links.router_lost
        while True:
            await lost.wait()
            lost.clear()
            await forget_dead_routes(self._config)
            await asyncio.sleep(_ROUTERS_EVERY)

    def _declare_first(
        self,
        session: zenoh.Session,
        declarations: Declarations,
        links: Inbox[zenoh.TransportEvent | zenoh.LinkEvent],
    ) -> list[object]:
        """Declares everything that a standby gateway serves too."""
        declared = [*self._links.declare(session, links)]
        declarations.status()
        if self.admission.standby.enabled:
            declarations.token()
        return declared

    def _declare_plant(self, declarations: Declarations) -> None:
        """The token comes last: a client that sees it may query at once."""
        declarations.plant()
        if not self.admission.standby.enabled:
            declarations.token()

    async def _close(self, session: zenoh.Session) -> None:
        await self._incoming.close()
        try:
            async with asyncio.timeout(CLOSE_WITHIN - 2 * _FLUSH_TIMEOUT):
                await off_loop(self._close_session, session)
        except TimeoutError:
            log.warning("Zenoh close timed out")
        self._incoming.end()

    def _close_session(self, session: zenoh.Session) -> None:
        self._publisher.stop(_FLUSH_TIMEOUT)
        session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it

    def _record(self, time: int, outcome: str, *, refused: bool) -> None:
        self._parts.audit(time, outcome)
        with suppress(Busy):  # a stopped history is a fault already
            if (history := self._parts.history()) is not None:
                history.record_write(time, outcome, refused=refused)

    async def _watch_publisher(self) -> None:
        await self._publisher.ended.wait()
        raise GatewayError("the publishing thread has ended: nothing would be published any more")

    def _collect_status(self) -> Mapping[str, Mapping[str, object]]:
        documents = dict(self._plant.status())
        documents["status"] = {**documents["status"], **self.admission.claiming.status()}
        links = {"to": self._links.kinds(), "connect": endpoints(self._config, "connect")}
        most = {"superseded_most": self._publisher.most_superseded()}
        zenoh_document = {**self.counters(), **most, **links}
        own = {"zenoh": zenoh_document, "outcomes": self._incoming.outcomes()}
        origins = {
            device.name: word
            for device in self._plant.devices()
            for tag in [*device.tags][:1]
            if (word := tag.origin.not_real) is not None
        }
        found = {**documents, **own, **self.admission.documents(origins)}
        return {**found, "report": report(found)}


def check(config: Config) -> list[str]:
    """Checks Zenoh settings and files without opening anything. Returns warnings, as sentences.
    Raises `ConfigError`."""
    Keys(config.zenoh.prefix, config.name)
    session = configure(config.zenoh)
    if config.writers_file is not None:
        Writers(config.writers_file)
    secrets.plant_secret(config.secret_file)
    found = _exposures(session, config.writers_file, group_settings(config))
    if config.secured:
        from gateway.contract.access.certificates import check as certificates  # takes 10 ms

        found += certificates(config)
    return found


def group_settings(config: Config) -> GroupSettings:
    return GroupSettings(config.standby, config.standby_alone, config.secret_file)


def _exposures(session: zenoh.Config, writers: Path | None, group: GroupSettings) -> list[str]:
    found = exposures.exposures(session)
    if writers is not None:
        found += exposures.unruled(session)
    if group.group is not None and group.secret_file is None:
        found += exposures.unsigned()
    return found
