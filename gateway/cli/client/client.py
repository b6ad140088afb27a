"""The client of a running gateway: reads and follows."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import cached_property, partial
from itertools import pairwise
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import orjson
import zenoh

from gateway.cli.client.arguments import matches, tags_by_key
from gateway.cli.client.rows import TagRow, document, raw, reason, without_gateway
from gateway.cli.client.tracing import traced
from gateway.cli.client.value_pages import CHANGED, REPLY_TIMEOUT, paged
from gateway.config import ZenohConfig
from gateway.config.gateway_address import GatewayAddress
from gateway.contract.keys import Keys
from gateway.errors import GatewayError
from gateway.northbound.session.everywhere import everywhere

if TYPE_CHECKING:
    from gateway.cli.client.requests import Requests
    from gateway.config import Config

_LONGEST_LIST = 10  # tags in one sentence


class NoGateway(GatewayError):
    """The gateway of a file does not run, or cannot be reached: it has no port open."""


class Client:
    """One session to the gateway of a configuration. Blocking calls, for the command line only.

    Tags outside the configuration belong to another gateway and are left out. `tell` gets
    sentences for people. `user` is the user name of the session, if there is one.
    """

    def __init__(
        self,
        session: zenoh.Session,
        config: "Config | GatewayAddress",
        tell: Callable[[str], None],
        user: str | None = None,
    ) -> None:
        self._session = session
        self._keys = Keys(config.zenoh.prefix, config.name)
        self._has_standby = config.standby is not None
        self._tags = tags_by_key(config)
        self._only_blocks = [device for device in config.devices if device.blocks == "only"]
        self._dialling = config.dialling
        self._tell = tell
        self._user = user
        self._duplicated: set[str] = set()  # devices of several gateways, reported once
        self._will_query = False  # because a device went online or offline

    @cached_property
    def requests(self) -> "Requests":
        """Writes, commands and orders to this gateway."""
        from gateway.cli.client.requests import Requests  # with signatures, and all about tags

        known = self._session, self._keys, self._tags, self._dialling
        return Requests(*known, self._query, self._user)

    @property
    def no_reply(self) -> str:
        """The sentence for a query without a reply. Zenoh drops forbidden queries silently."""
        allowed = f", and may {self._user} query it" if self._user else ""
        return f"no reply: is the gateway of this file running{allowed}?"

    def values(self, wanted: str, max_age: str | None = None) -> list[TagRow]:
        """Returns the current values of the tags that a key expression matches, by name.

        The key expression has no prefix. When two gateways reply for a device, the result has
        both values of each tag, and `tell` gets a warning.
        """
        key = self._keys.value(wanted)
        if "*" in wanted and not max_age:
            samples = paged(self._answers, key)
        else:
            replies = self._answers(f"{key}?max_age={max_age}" if max_age else key)
            samples = (reply.ok for reply in replies if reply.ok is not None)
        found = [row for sample in samples if (row := self._row(sample)) is not None]
        found.sort(key=lambda row: row.tag)
        self._report_duplicates(found)
        return found

    def report_missing(self, wanted: list[str], rows: Sequence[TagRow]) -> bool:
        """Reports the wanted tags of the file without a row. Returns True when there are none."""
        found = {row.tag for row in rows}
        missing = [key for key in self._tags if key not in found and matches(key, wanted)]
        if missing:
            rest = len(missing) - _LONGEST_LIST
            more = f" and {rest} more" if rest > 0 else ""
            self._tell(f"no reply for {', '.join(missing[:_LONGEST_LIST])}{more}: {CHANGED}")
        return not missing

    def status(self, path: str = "status") -> dict[str, object]:
        """Returns `status`, `lines/<line>` or `devices/<device>` of the gateway."""
        for reply in self._query(self._keys.status(path)):
            if reply.ok is not None:
                return document(reply.ok.payload.to_bytes())
        raise NoGateway(self.no_reply)

    def documents(self) -> dict[str, dict[str, Any]]:
        """Returns all status documents by path: `status`, `lines/<line>`, `devices/<device>`."""
        stem = self._keys.status("")
        found = {
            str(reply.ok.key_expr).removeprefix(stem): document(reply.ok.payload.to_bytes())
            for reply in self._query(self._keys.status("**"))
            if reply.ok is not None
        }
        if "status" not in found:
            raise NoGateway(self.no_reply)
        return found

    def of(self, gateway: str) -> "Client":
        """Returns a client of another gateway, by prefix and name, with the same session."""
        prefix, _, name = gateway.rpartition("/")
        place = GatewayAddress(name=name, standby=None, zenoh=ZenohConfig(prefix=prefix))
        return Client(self._session, place, self._tell, self._user)

    def everywhere(self, path: str) -> Iterator[tuple[str, bytes, float]]:
        """Returns key, payload and arrival (s since 1970) of a document of each gateway under the
        prefix. One that hangs delays the end by `REPLY_TIMEOUT`, and nothing else."""
        return everywhere(self._session, self._keys, path, REPLY_TIMEOUT)

    def outcomes(self, since: str) -> list[dict[str, Any]] | None:
        """Returns the outcomes of writes since a time as in `_time`; None without history."""
        replies = self._query(f"{self._keys.writes}?_time=[{since}..]")
        if any(reply.err is not None for reply in replies):
            return None
        return [document(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]

    def alarms(self) -> list[dict[str, Any]]:
        """Returns the document of each alarm. Raises `GatewayError`."""
        replies = self._answers(self._keys.status("alarms/**"))
        if not replies:
            self.status()  # a gateway may have no alarms
        return [document(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]

    def past_alarms(self, since: str) -> list[dict[str, Any]]:
        """Returns the changes of alarms since a time as in `_time`, in the order of time. Raises
        `GatewayError`, also without history."""
        replies = self._answers(self._keys.status(f"alarms/**?_time=[{since}..]"))
        for reply in replies:
            if reply.err is not None:
                raise GatewayError(str(document(reply.err.payload.to_bytes())["reason"]))
        found = [document(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
        return sorted(found, key=lambda row: str(row["since"]))

    def trace(self, line: str, until: float | None) -> Iterator[dict[str, Any]]:
        """Yields the trace of a line, in parts. Raises `GatewayError` if nobody serves it."""
        session, keys = self._session, self._keys
        served = partial(self.status, f"lines/{line}")
        return traced(session, keys, line, until, served, self._tell)

    def follow(self, wanted: list[str]) -> Generator[TagRow, None, None]:
        """Yields the current values, then every change, without end.

        When the gateway ends, all values become bad: `no-gateway`. When it returns, or another
        member of its standby group becomes active, the client queries the values again. Without
        one at the start it waits.
        """
        news: SimpleQueue[TagRow | bool] = SimpleQueue()
        with ExitStack() as stack:
            for subscriber in self._subscribers(wanted, news.put):
                stack.enter_context(subscriber)
            for watcher in self._watchers(news.put):
                stack.enter_context(watcher)
            rows = self._all(wanted)
            if rows:
                self.report_missing(wanted, rows)
            else:
                self._tell(f"{self.no_reply} This command waits for it")
            known: set[str] = set()  # tags with a value now
            present = bool(rows)
            while True:
                known.update(row.tag for row in rows)
                yield from rows
                event = news.get()
                if present and isinstance(event, TagRow):
                    rows = [event]
                    continue
                self._will_query = False
                # A value without a gateway is late, or from a gateway that became active: only the
                # latter replies to a query. Values that arrive meanwhile are newer and follow it.
                try:
                    rows = self._all(wanted) if event else []
                except GatewayError:
                    rows = []
                    news.put(True)
                    continue
                present = bool(rows)
                lost = known.difference(row.tag for row in rows)
                known -= lost
                yield from map(without_gateway, sorted(lost))

    def _all(self, wanted: list[str]) -> list[TagRow]:
        return [row for key in wanted for row in self.values(key)]

    def _subscribers(
        self, wanted: list[str], put: Callable[[TagRow], None]
    ) -> Iterator[zenoh.Subscriber[None]]:
        """Yields subscribers to the values, and to the blocks of devices without single values."""

        def arrived(sample: zenoh.Sample) -> None:
            if (row := self._row(sample)) is not None:
                put(row)

        def unpacked(tags: dict[str, str], sample: zenoh.Sample) -> None:
            with suppress(orjson.JSONDecodeError):
                for name, known in document(sample.payload.to_bytes()).items():
                    if name in tags and isinstance(known, dict):
                        put(TagRow(tags[name], known))

        for key in wanted:
            yield self._session.declare_subscriber(self._keys.value(key), arrived)
        for device in self._only_blocks:
            # Event tags have values of their own in any case.
            members = [
                tag for tag in device.tags if not tag.publishing.event and matches(tag.key, wanted)
            ]
            if members:
                take = partial(unpacked, {tag.name: tag.key for tag in members})
                yield self._session.declare_subscriber(self._keys.block(device.name), take)

    def _watchers(self, put: Callable[[bool], None]) -> tuple[AbstractContextManager[object], ...]:
        """Returns watchers of the gateway: they put True to query again, False when it is lost.

        In a standby group the start or end of any member may change the active one: query again.
        So it is with a device: its values may be lost on the way.
        """
        key = self._keys.own
        if self._has_standby:
            key = f"{key.rpartition('/')[0]}/*"

        def device(_: zenoh.Sample) -> None:
            if not self._will_query:  # one query serves all devices
                self._will_query = True
                put(True)

        def token(sample: zenoh.Sample) -> None:
            put(self._has_standby or sample.kind == zenoh.SampleKind.PUT)

        def link(event: zenoh.TransportEvent) -> None:
            if event.kind == zenoh.SampleKind.DELETE:  # its token reports the return
                put(False)

        return (
            self._session.liveliness().declare_subscriber(key, token),
            self._session.liveliness().declare_subscriber(f"{key}/alive/*", device),
            self._session.info.declare_transport_events_listener(link),
        )

    def _answers(self, selector: str) -> list[zenoh.Reply]:
        """Raises `GatewayError` for an error reply too."""
        replies = self._query(selector)
        for reply in replies:
            if reply.err is not None:
                raise GatewayError(reason(reply.err.payload.to_bytes()))
        return replies

    def _query(self, selector: str) -> list[zenoh.Reply]:
        try:
            return list(
                self._session.get(
                    selector,
                    timeout=REPLY_TIMEOUT,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    accept_replies=zenoh.ReplyKeyExpr.ANY,  # the end of a page has its own key
                )
            )
        except zenoh.ZError as error:
            raise GatewayError(f"{selector}: {error}") from None

    def _row(self, sample: zenoh.Sample) -> TagRow | None:
        tag = self._tags.get(self._keys.tag(str(sample.key_expr)) or "")
        with suppress(orjson.JSONDecodeError):
            if tag is not None and sample.attachment is not None:
                return TagRow(tag.key, raw(tag, sample, sample.attachment.to_bytes()))
            if tag is not None and sample.kind == zenoh.SampleKind.PUT:
                return TagRow(tag.key, document(sample.payload.to_bytes()))
        return None

    def _report_duplicates(self, rows: list[TagRow]) -> None:
        """Reports each device with several gateways. `rows` are the sorted replies to one query."""
        duplicated = {
            self._tags[row.tag].device
            for row, following in pairwise(rows)
            if row.tag == following.tag
        }
        for device in sorted(duplicated - self._duplicated):
            self._tell(f"more than one gateway replies for {device}: their values may differ")
        self._duplicated |= duplicated
