"""One session to a running gateway: ask, write, follow."""

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from itertools import pairwise
from queue import SimpleQueue
from typing import NamedTuple

import orjson
import zenoh

from gateway.tags.timestamps import rfc3339
from gateway.cli.client.typed import matches, parse_value
from gateway.config import Config
from gateway.config.commands import TO_ALL
from gateway.errors import GatewayError
from gateway.northbound.keys import Keys
from gateway.tags import Tag
from gateway.values import Kind, Value

TOKEN_VARIABLE = "PLC_GATEWAY_WRITE_TOKEN"  # noqa: S105  (the name of a variable)
PATIENCE = 10.0  # seconds a question may take
_CHANGED = "does the gateway run with this file as it is now?"
_NAMED = 10  # tags in one sentence


class Shown(NamedTuple):
    """A sample as it arrived: `document` is the decoded payload."""

    tag: str  # device/name
    document: dict[str, object]


class Client:
    """One session to the gateway of a configuration. Blocking calls, for the command line only.

    Tags that are not in the configuration are another gateway's, and left out. `tell` gets
    sentences for people. `user` is the name we are known by, where we gave one.
    """

    def __init__(
        self,
        session: zenoh.Session,
        config: Config,
        tell: Callable[[str], None],
        user: str | None = None,
    ) -> None:
        self._session = session
        self._keys = Keys(config.zenoh.prefix, config.name)
        self._stands_by = config.standby is not None
        self._tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self._only_blocks = [device for device in config.devices if device.blocks == "only"]
        self._tell = tell
        self._user = user
        self._doubled: set[str] = set()  # devices, told of

    @property
    def nothing(self) -> str:
        """What may be wrong when nobody answers. Zenoh denies without a word."""
        allowed = f", and may {self._user} ask it" if self._user else ""
        return f"nothing was answered: is the gateway of this file running{allowed}?"

    def values(self, wanted: str, max_age: str | None = None) -> list[Shown]:
        """The current values of the tags a key expression (without the prefix) names, by name.

        Where two gateways answer for a device, both values of each of its tags, and it is told.
        """
        selector = self._keys.value(wanted) + (f"?max_age={max_age}" if max_age else "")
        found = []
        for reply in self._ask(selector):
            if reply.err is not None:
                raise GatewayError(_reason(reply.err.payload.to_bytes()))
            if reply.ok is not None and (shown := self._shown(reply.ok)) is not None:
                found.append(shown)
        found.sort(key=lambda row: row.tag)
        self._tell_of_doubled(found)
        return found

    def complete(self, wanted: list[str], rows: Sequence[Shown]) -> bool:
        """Whether each wanted tag of the file is in a row; those that are not are told."""
        answered = {row.tag for row in rows}
        lost = [key for key in self._tags if key not in answered and matches(key, wanted)]
        if lost:
            more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
            self._tell(f"nothing was answered for {', '.join(lost[:_NAMED])}{more}: {_CHANGED}")
        return not lost

    def status(self, path: str = "status") -> dict[str, object]:
        """`status`, `lines/<line>` or `devices/<device>` of the gateway."""
        for reply in self._ask(self._keys.status(path)):
            if reply.ok is not None:
                return _document(reply.ok.payload.to_bytes())
        raise GatewayError(self.nothing)

    def write(self, tag: str, value: Value) -> dict[str, object]:
        """The outcome as the gateway told it: `value ...` or `error ...`.

        Raises `GatewayError` when nobody was there to hear it, or nobody answered.
        """
        # Not orjson, which knows no integer beyond 64 bits: a float tag takes one.
        return self._order(self._keys.set(tag), json.dumps(value).encode())

    def control(self, line: str, device: str, command: str, argument: str) -> dict[str, object]:
        """What the device said: `answer ...` or `error ...`. Raises as `write`."""
        to_all = command == TO_ALL
        key = self._keys.to_all(line) if to_all else self._keys.command(device, command)
        return self._order(key, argument.encode())

    def follow(self, wanted: list[str]) -> Iterator[Shown]:
        """The current values, then every change as it comes, without end.

        When the gateway goes, what was good is bad: `no-gateway`; when it returns, or another of
        its standby group goes on duty, the values are asked for again. Raises `GatewayError` when
        there is none to begin with.
        """
        news: SimpleQueue[Shown | bool] = SimpleQueue()
        with ExitStack() as stack:
            for subscriber in self._subscribed(wanted, news.put):
                stack.enter_context(subscriber)
            for watcher in self._gateway_seen(news.put):
                stack.enter_context(watcher)
            rows = self._all(wanted)
            if not rows:
                raise GatewayError(self.nothing)
            self.complete(wanted, rows)
            known: set[str] = set()  # what nobody knows any more is left out
            there = True
            while True:
                known.update(row.tag for row in rows)
                yield from rows
                event = news.get()
                if there and isinstance(event, Shown):
                    rows = [event]
                    continue
                # What comes while there is no gateway is late, or from one that took over: asked,
                # only the latter answers. What arrives meanwhile is newer, and handed on after it.
                try:
                    rows = self._all(wanted) if event else []
                except GatewayError:
                    rows = []
                    news.put(True)
                    continue
                there = bool(rows)
                lost = known.difference(row.tag for row in rows)
                known -= lost
                yield from map(_lost, sorted(lost))

    def _all(self, wanted: list[str]) -> list[Shown]:
        return [row for want in wanted for row in self.values(want)]

    def _subscribed(
        self, wanted: list[str], told: Callable[[Shown], None]
    ) -> Iterator[zenoh.Subscriber[None]]:
        """To the values, and to the blocks of the devices that put nothing else."""

        def arrived(sample: zenoh.Sample) -> None:
            got = self._shown(sample)
            if got is not None:
                told(got)

        def unpacked(tags: dict[str, str], sample: zenoh.Sample) -> None:
            with suppress(orjson.JSONDecodeError):
                for name, known in _document(sample.payload.to_bytes()).items():
                    if name in tags and isinstance(known, dict):
                        told(Shown(tags[name], known))

        for want in wanted:
            yield self._session.declare_subscriber(self._keys.value(want), arrived)
        for device in self._only_blocks:
            # Event tags are put one by one in any case.
            mine = [tag for tag in device.tags if not tag.event and matches(tag.key, wanted)]
            if mine:
                yield self._session.declare_subscriber(
                    self._keys.block(device.name),
                    partial(unpacked, {tag.name: tag.key for tag in mine}),
                )

    def _gateway_seen(
        self, told: Callable[[bool], None]
    ) -> tuple[AbstractContextManager[object], ...]:
        """True when it is to be asked again, False when it is gone, or the only link to it.

        In a standby group whoever goes or comes may be the one that served or will.
        """
        seen = self._keys.own
        if self._stands_by:
            seen = f"{seen.rpartition('/')[0]}/*"

        def token(sample: zenoh.Sample) -> None:
            told(self._stands_by or sample.kind == zenoh.SampleKind.PUT)

        def link(event: zenoh.TransportEvent) -> None:
            if event.kind == zenoh.SampleKind.DELETE:  # when it is back, the token says so
                told(False)

        return (
            self._session.liveliness().declare_subscriber(seen, token),
            self._session.info.declare_transport_events_listener(link),
        )

    def _ask(self, selector: str) -> list[zenoh.Reply]:
        try:
            return list(
                self._session.get(
                    selector, timeout=PATIENCE, consolidation=zenoh.ConsolidationMode.NONE
                )
            )
        except zenoh.ZError as error:
            raise GatewayError(f"{selector}: {error}") from None

    def _order(self, key: str, payload: bytes) -> dict[str, object]:
        """What was answered to a write or a command, which is sent only if somebody takes it.

        Its gateway is asked for its state before. Zenoh's own messages stay in order, so who
        takes the order is known then; and a frozen gateway does not get what it would do later,
        when nobody waits for it any more.
        """
        with self._session.declare_querier(key, timeout=PATIENCE) as querier:
            self._ask(self._keys.status("status"))
            if not querier.matching_status.matching:  # type: ignore[attr-defined]  # no bool
                may = f"may {self._user} do this, and " if self._user else ""
                raise GatewayError(f"no gateway takes {key}: nothing was sent; {may}{_CHANGED}")
            for reply in querier.get(payload=payload, attachment=os.environ.get(TOKEN_VARIABLE)):
                answer = reply.ok or reply.err
                with suppress(orjson.JSONDecodeError):  # Zenoh's own `Timeout` is none
                    if answer is not None:
                        return _document(answer.payload.to_bytes())
        raise GatewayError(f"{key}: no answer: nobody knows whether it was done")

    def _shown(self, sample: zenoh.Sample) -> Shown | None:
        tag = self._tags.get(self._keys.tag(str(sample.key_expr)) or "")
        with suppress(orjson.JSONDecodeError):
            if tag is not None and sample.attachment is not None:
                return Shown(tag.key, _raw(tag, sample, sample.attachment.to_bytes()))
            if tag is not None and sample.kind == zenoh.SampleKind.PUT:
                return Shown(tag.key, _document(sample.payload.to_bytes()))
        return None

    def _tell_of_doubled(self, rows: list[Shown]) -> None:
        """`rows` are the sorted answers to one question."""
        doubled = {
            self._tags[row.tag].device
            for row, following in pairwise(rows)
            if row.tag == following.tag
        }
        for device in sorted(doubled - self._doubled):
            self._tell(f"more than one gateway answers for {device}: their values may differ")
        self._doubled |= doubled


def _lost(tag: str) -> Shown:
    """Nobody knows the value any more."""
    now = rfc3339(time.time_ns())
    return Shown(tag, {"value": None, "quality": "bad", "reason": "no-gateway", "time": now})


def _raw(tag: Tag, sample: zenoh.Sample, about: bytes) -> dict[str, object]:
    """What a tag with `payload: raw` says, as the others say it."""
    value: Value | None = None
    if sample.kind == zenoh.SampleKind.PUT:
        text = sample.payload.to_bytes().decode("utf-8", "replace")
        value = text if tag.layout.type.kind is Kind.STRING else parse_value(text)
    return {"value": value, **_document(about)}


def _document(data: bytes) -> dict[str, object]:
    found = orjson.loads(data)
    return found if isinstance(found, dict) else {"value": found}


def _reason(data: bytes) -> str:
    with suppress(orjson.JSONDecodeError):
        return str(_document(data).get("reason", data.decode("utf-8", "replace")))
    return data.decode("utf-8", "replace")
