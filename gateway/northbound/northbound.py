"""The gateway as Zenoh sees it: values out, questions answered, writes taken, signs of life."""

import asyncio
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeVar

import structlog
import zenoh

from gateway.config import ZenohConfig, ZenohMode
from gateway.errors import GatewayError
from gateway.northbound import payload, secrets
from gateway.northbound.audit import Audit
from gateway.northbound.controls import Commanded, Controls
from gateway.northbound.directory import Directory
from gateway.northbound.duty import Duty, StandbySettings
from gateway.northbound.inbox import Inbox
from gateway.northbound.keys import Keys
from gateway.northbound.links import Links
from gateway.northbound.payload import WriteOutcome
from gateway.northbound.plant import History, Plant
from gateway.northbound.publisher import Publisher
from gateway.northbound.queries import Queries
from gateway.northbound.repeater import Repeater
from gateway.northbound.replies import Replies
from gateway.northbound.scans import Scans
from gateway.northbound.session import (
    CLOSE_WITHIN,
    configure,
    off_loop,
    opened,
)
from gateway.northbound.writers import Writers
from gateway.northbound.writes import PutWrites, Writes
from gateway.tags import Sample

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)
T = TypeVar("T")

STATUS_EVERY = 5.0  # seconds
_PATIENCE = 0.5  # seconds for what still waits to be put when the gateway ends


class Northbound:
    """One Zenoh session and what is declared on it. Every method belongs to the event loop.

    With `standby` it first waits, served by nobody but its own status, until it is on duty:
    `on_duty` is set when the lines may be opened, `relieved` when they must be closed and this
    ended. Without, it is on duty from the beginning.

    Raises `ConfigError` when made with a bad prefix, name, endpoint, Zenoh or writers file, or
    with a secret that everybody on this machine could read.
    """

    def __init__(
        self,
        settings: ZenohConfig,
        name: str,
        plant: Plant,
        *,
        history: History | None = None,
        record_write: Callable[[WriteOutcome], None] | None = None,
        writers: Path | None = None,
        commanded: Commanded | None = None,
        standby: StandbySettings | None = None,
        status_every: float = STATUS_EVERY,
    ) -> None:
        """`record_write` gets every outcome that is told, on the event loop; it must not block.
        `writers` is the file of those who may write; without it all that Zenoh lets through.
        `commanded` takes commands such as stop; without it there are none.
        """
        self.keys = Keys(settings.prefix, name)
        self.sole = asyncio.Event()  # set when files and lines may be touched, see `run`
        self.opened = asyncio.Event()  # everything is declared, all current values are queued
        self._config = configure(settings)
        self._retry = settings.mode is ZenohMode.CLIENT
        if self._retry:
            self.sole.set()  # it listens to nobody, and may wait for its router for ever
        self._writers = None if writers is None else Writers(writers)
        self._links = Links()
        self._duty = Duty(standby, self.keys, self._config)
        self._plant = plant
        self._commanded = commanded
        self._commands: list[str] = []  # keys
        self._history = history
        self._status_every = status_every
        self._publisher = Publisher(self.keys)
        self._audit = Audit(partial(self._publisher.document, self.keys.writes), record_write)
        self._directory = Directory(self.keys, ())
        self._declared: list[object] = []
        self._queries: Queries | None = None
        self._scans = Scans(self._publisher)
        self._puts: PutWrites | None = None
        self._documents: tuple[float, dict[str, bytes]] = (float("-inf"), {})

    # -- from the gateway --

    def publish(self, samples: Sequence[Sample]) -> None:
        """Sends samples out, and per device with blocks all of them in one. Never blocks.

        One call is one scan. The plant's own samples must be updated before. Those of event tags
        all go out, in order, none replaced by the next.
        """
        self._scans.publish(samples)

    def publish_events(self, samples: Iterable[Sample]) -> None:
        """Sends out every sample in order, none replaced by the next. Never blocks."""
        self._publisher.events(samples)

    def alive(self, device: str, alive: bool) -> None:
        """Whether the device answers: its liveliness token."""
        self._publisher.alive(device, alive)

    def counters(self) -> dict[str, int]:
        """What went out, came in and was dropped since the start."""
        counted = asdict(self._publisher.counters)
        if self._queries is not None:
            counted |= asdict(self._queries.counters)
        if self._puts is not None:
            counted["puts_refused"] = self._puts.refused
        return counted | {"links": len(self._links), "refusals_untold": self._audit.untold}

    @property
    def on_duty(self) -> asyncio.Event:
        """Set when this gateway may go on the wire: at once without `standby`."""
        return self._duty.on

    @property
    def relieved(self) -> asyncio.Event:
        """Set when another gateway of the group is active: leave the wire, then end this."""
        return self._duty.relieved

    # -- life --

    async def run(self) -> None:
        """Serves until cancelled; the session is closed whatever happens, within 2 s.

        Once only: for another session make another `Northbound`. Raises `GatewayError` when the
        session cannot be opened (a client waits for its router), and an `ExceptionGroup` with
        whatever ended it later. Once it is open, which sets `sole`, no gateway started a second
        time gets so far: the endpoint is taken.
        """
        for exposure in secrets.exposures(self._config):
            log.warning(exposure)
        session = await opened(self._config, retry=self._retry)
        self.sole.set()
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
        self._scans.of(devices)
        self._publisher.start(session)
        writes = Writes(self.keys, self._plant, self._directory, self._audit, self._writers)
        stamp = session.new_timestamp
        replies = Replies(self.keys, self._plant, self._directory, stamp, self._history)
        controls = None
        if self._commanded is not None:
            controls = Controls(self.keys, self._commanded, stamp, self._audit, self._writers)
            self._commands = controls.queryables
        self._queries = Queries(
            self._plant, self._directory, writes, replies, self._status, controls
        )
        queries = Inbox(self._queries.take, self._queries.refuse)
        self._puts = PutWrites(writes, self._directory)
        puts = Inbox(self._puts.take, self._puts.refuse)
        links = Inbox(self._links.take, lambda _: None)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch())
            tasks.create_task(self._duty.run(session))
            # Kept, for what is forgotten is undeclared.
            self._declared += await off_loop(self._declare_own, session, queries, links)
            tasks.create_task(self._tell_status())
            await self._duty.on.wait()
            self._declared += await off_loop(self._declare_plant, session, queries, puts)
            repeater = Repeater(self._scans.publish, self._plant, self._directory, self._links)
            await repeater.publish_all()
            self._publish_status()
            self.opened.set()
            log.info("on Zenoh", prefix=self.keys.prefix, id=str(session.zid()))
            tasks.create_task(repeater.run())

    def _declare_own(
        self,
        session: zenoh.Session,
        queries: Inbox[zenoh.Query],
        links: Inbox[zenoh.TransportEvent],
    ) -> list[object]:
        """What is there also while another gateway is active. It lives as long as the session."""
        return [
            self._links.declare(session, links),
            session.declare_queryable(self.keys.statuses, _directly(queries), complete=False),
            *([self._declare_token(session)] if self._duty.stands_by else []),
        ]

    def _declare_plant(
        self, session: zenoh.Session, queries: Inbox[zenoh.Query], puts: Inbox[zenoh.Sample]
    ) -> list[object]:
        """Values are not `complete`: others may share the prefix, and all are to be asked. A
        device has one gateway, and its writes go to one queryable, however many would take them.
        """
        ask = _directly(queries)
        mine = self._directory.devices
        shared = (self.keys.values, self.keys.late, self.keys.metas)
        blocks = (self.keys.blocks,) if self._scans.with_blocks else ()
        return [
            *(session.declare_queryable(key, ask, complete=False) for key in (*shared, *blocks)),
            *(
                session.declare_queryable(self.keys.sets(device.name), ask, complete=True)
                for device in mine
            ),
            *(session.declare_queryable(key, ask, complete=True) for key in self._commands),
            session.declare_subscriber(
                f"{self.keys.values}/@set",
                _directly(puts),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
            # Last: whoever sees it may ask at once.
            *([] if self._duty.stands_by else [self._declare_token(session)]),
        ]

    def _declare_token(self, session: zenoh.Session) -> object:
        return session.liveliness().declare_token(self.keys.own)

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

    async def _watch(self) -> None:
        await self._publisher.ended.wait()
        raise GatewayError("the publishing thread has ended: nothing would be published any more")

    async def _tell_status(self) -> None:
        while True:
            await asyncio.sleep(self._status_every)
            self._audit.tell_rest()
            self._publish_status()

    def _publish_status(self) -> None:
        for key, document in self._status().items():
            self._publisher.document(key, document)

    def _status(self) -> dict[str, bytes]:
        """Every status document by its key; at most a fifth of a second old, however many ask."""
        made, documents = self._documents
        now = time.monotonic()
        if now - made > 0.2:
            own = {
                "zenoh": {**self.counters(), "to": self._links.kinds()},
                **self._duty.documents(),
            }
            documents = {
                self.keys.status(path): payload.document(fields)
                for path, fields in {**self._plant.status(), **own}.items()
            }
            self._documents = (now, documents)
        return documents


def _directly(inbox: Callable[[T], None]) -> "zenoh.handlers.Callback[T]":
    """On Zenoh's receiving thread: an inbox only appends, and a thread for each declaration would
    be needed otherwise."""
    return zenoh.handlers.Callback(inbox, indirect=False)
