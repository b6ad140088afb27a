"""Everything that clients send to this gateway: queries and puts, from declaration to end."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import TypeVar

import zenoh

from gateway.contract.documents.state import OutcomesDocument
from gateway.contract.interfaces import Parts, Plant
from gateway.contract.keys import Keys
from gateway.contract.payload import GroupResult
from gateway.contract.problems import Failure
from gateway.northbound.answering.queries import Queries, StatusDocuments
from gateway.northbound.answering.replies import Replies
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.commands import Commands, Orders
from gateway.northbound.requests.inbox import Inbox
from gateway.northbound.requests.writes import OwnWrites, PutWrites, Writes
from gateway.tags import WriteResult

T = TypeVar("T")


@dataclass(eq=False)
class Incoming:
    """Made once; `start` connects it to the open session. Belongs to the event loop."""

    _keys: Keys
    _plant: Plant
    _index: TagIndex
    _audit: Audit
    _documents: StatusDocuments
    _parts: Parts
    _acceptance: Acceptance
    _queries: Queries | None = None
    _puts: PutWrites | None = None
    _declarations: "Declarations | None" = None

    def __post_init__(self) -> None:
        # Of clients that another part of the gateway has admitted: Zenoh and its writers do not.
        admitted = Acceptance(self._plant.duty, None)
        self._admitted = Writes(self._plant, self._index, self._audit, admitted)
        self.own_writes = OwnWrites(self._keys, self._plant, self._audit)
        self._admitted_orders = Orders(self._keys, self._parts, self._audit, admitted)

    def counters(self) -> dict[str, int]:
        """Queries and puts since the start."""
        counted = {"refusals_untold": self._audit.suppressed}
        if self._queries is not None:
            counted |= asdict(self._queries.counters)
        if self._puts is not None:
            counted["puts_refused"] = self._puts.refused
        return counted

    def outcomes(self) -> OutcomesDocument:
        """Counts of writes and commands by outcome, and their times."""
        return self._audit.counts.document()

    async def write(
        self, tag: str, data: bytes, by: str, arrived: float
    ) -> WriteResult | Failure | GroupResult:
        """Writes for a client that another part of the gateway has admitted as `by`. `data` is the
        payload as on Zenoh; `arrived`: by the loop's clock."""
        return await self._admitted.write(self._keys.set(tag), data, Sender(by, None, arrived))

    async def order(
        self, part: str, path: str, data: bytes, by: str, arrived: float
    ) -> bytes | Failure:
        """Has a part carry out an order of a client that another part has admitted as `by`."""
        key = self._keys.status(f"{part}/{path}")
        return await self._admitted_orders.execute(part, key, data, Sender(by, None, arrived))

    def start(self, session: zenoh.Session) -> "Declarations":
        """Returns the declarations that send queries and puts here."""
        stamp = session.new_timestamp
        writes = Writes(self._plant, self._index, self._audit, self._acceptance)
        commands = Commands(self._keys, self._plant, self._audit, self._acceptance)
        signed = self._acceptance.signed
        replies = Replies(self._keys, self._plant, self._index, stamp, self._parts, signed)
        orders = Orders(self._keys, self._parts, self._audit, self._acceptance)
        self._queries = Queries(
            self._plant,
            self._index,
            writes,
            commands,
            replies,
            self._documents,
            orders,
            self._parts,
        )
        self._puts = PutWrites(writes, self._index)
        puts = Inbox(self._puts.take, self._puts.refuse)
        self._declarations = Declarations(
            session, self._keys, self._plant, self._index, self._queries.inbox(), puts
        )
        return self._declarations

    def begin(self) -> None:
        """Call it when the gateway becomes active, before it takes queries for the plant."""
        self._acceptance.begin()

    def become(self, index: TagIndex) -> frozenset[str]:
        """Serves other devices from now on. Returns the names of those that have gone."""
        gone = self._index.names - index.names
        self._index.become(index)
        return gone

    def changed(self) -> None:
        """Declares the keys of changed devices. Blocks."""
        if self._declarations is not None:
            self._declarations.changed()

    async def close(self) -> None:
        """Ends what waits for devices; replies that are on their way get half a second."""
        if self._puts is not None:
            self._puts.close()
        if self._queries is not None:
            await self._queries.close()

    def end(self) -> None:
        """Ends the answering threads, after the session is closed."""
        if self._queries is not None:
            self._queries.end()


@dataclass(eq=False)
class Declarations:
    """Declares queryables, subscribers and tokens. Each call blocks: not on the event loop.

    Zenoh undeclares an object that is no longer referenced, so this one must live as long.
    """

    _session: zenoh.Session
    _keys: Keys
    _plant: Plant
    _index: TagIndex
    _queries: Callable[[zenoh.Query], None]
    _puts: Inbox[zenoh.Sample]
    _queryables: dict[str, zenoh.Queryable[None]] = field(default_factory=dict)  # by key
    _others: list[object] = field(default_factory=list)

    def status(self) -> None:
        """Declares the status keys; a standby gateway answers them too."""
        self._declare(self._status_keys())

    def plant(self) -> None:
        """Declares values, writes and commands; only the active gateway answers them.

        Other gateways may share the prefix, and Zenoh queries all of them, because no queryable is
        `complete`. So a write reaches each of them, and only the gateway of its device takes it.
        """
        self._declare(self._plant_keys())
        puts = self._session.declare_subscriber(
            self._keys.set("**"), _direct(self._puts), allowed_origin=zenoh.Locality.REMOTE
        )
        self._others.append(puts)

    def changed(self) -> None:
        """Declares the keys of other devices, and undeclares those that no device has any more."""
        wanted = self._plant_keys()
        self._declare(wanted)
        for key in self._queryables.keys() - {*wanted, *self._status_keys()}:
            self._queryables.pop(key).undeclare()  # type: ignore[no-untyped-call]  # as above

    def token(self) -> None:
        """Declares the gateway's liveliness token."""
        self._others.append(self._session.liveliness().declare_token(self._keys.own))

    def _status_keys(self) -> list[str]:
        return [self._keys.status("**"), self._keys.describe, self._keys.introspect]

    def _plant_keys(self) -> list[str]:
        """Returns the keys of values, writes and commands; those of a line are status keys."""
        commands = ["peek", *sorted(frozenset().union(*self._plant.commands().values()))]
        keys = [self._keys.values, self._keys.late, self._keys.meta("**")]
        keys += [self._keys.set("**"), *(self._keys.command("*", one) for one in commands)]
        return [*keys, self._keys.block("*")] if self._index.with_blocks else keys

    def _declare(self, keys: Iterable[str]) -> None:
        for key in keys:
            if key not in self._queryables:
                self._queryables[key] = self._session.declare_queryable(
                    key, _direct(self._queries), complete=False
                )


def _direct(inbox: Callable[[T], None]) -> "zenoh.handlers.Callback[T]":
    """Runs on Zenoh's receiving thread: an inbox only appends, so it needs no thread per
    declaration."""
    return zenoh.handlers.Callback(inbox, indirect=False)
