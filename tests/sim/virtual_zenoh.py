"""A Zenoh session on virtual time: what the gateway uses of it, and no more.

The gateway listens, and each peer has a link of its own. A peer is a client, or a router with
clients behind it. Nothing is stored: a put reaches the links that have a subscriber at that moment.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple, Protocol, Self

import zenoh

from tests.sim.pipe import Limits, Pipe, Rank
from tests.sim.threads import Turns

_BATCHES = ("control", "data", "data_low")
_WORK = 30e-6  # seconds of the gateway for one message
_CONSTANT = 300  # bytes of a message whose length differs from run to run


@lru_cache(maxsize=100_000)
def matches(expression: str, key: str) -> bool:
    return bool(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)))


class Transport(NamedTuple):
    """The other end of a link."""

    zid: str
    whatami: str


class LinkEvent(NamedTuple):
    """A link that was opened (PUT) or closed (DELETE)."""

    transport: Transport
    kind: zenoh.SampleKind


class Received(NamedTuple):
    """A sample, as a subscriber gets it."""

    key_expr: str
    payload: zenoh.ZBytes
    kind: zenoh.SampleKind = zenoh.SampleKind.PUT
    attachment: zenoh.ZBytes | None = None
    source_info: None = None
    encoding: zenoh.Encoding | None = None
    stamp: int = 0
    put_at: float = 0.0


class Reply(NamedTuple):
    """A reply to query `number`: a sample, or an error, or neither at the end."""

    number: int
    ok: Received | None = None
    err: bytes | None = None


class Token(NamedTuple):
    """A liveliness token that was declared or ended."""

    key: str
    declared: bool


class Peer(Protocol):
    """The other end of a link."""

    whatami: str

    @property
    def zid(self) -> str: ...

    @property
    def pipe(self) -> Pipe:
        """To the peer."""

    def wants(self, key: str) -> bool: ...

    @property
    def link(self) -> Any: ...


class Query:
    """A query of a peer."""

    source_info = None

    def __init__(
        self,
        session: "Session",
        peer: Peer,
        number: int,
        selector: str,
        payload: bytes | None,
        attachment: bytes | None,
        any_key: bool,
    ) -> None:
        key, _, parameters = selector.partition("?")
        self.key_expr = zenoh.KeyExpr(key)
        self.parameters = zenoh.Parameters(parameters)
        self.payload = None if payload is None else zenoh.ZBytes(payload)
        self.attachment = None if attachment is None else zenoh.ZBytes(attachment)
        self._session, self._peer, self._number = session, peer, number
        self._pipe = peer.pipe
        self._any_key = any_key
        self._ended = False

    def accepts_replies(self) -> zenoh.ReplyKeyExpr:
        return zenoh.ReplyKeyExpr.ANY if self._any_key else zenoh.ReplyKeyExpr.MATCHING_QUERY

    def reply(self, key: str, data: bytes, **about: Any) -> None:
        if not self._any_key and not self.key_expr.intersects(key):
            raise zenoh.ZError(f"{key} does not match {self.key_expr}")
        size = _CONSTANT if key.endswith(("/page", "/writes")) else len(key) + len(data)
        attachment = about.get("attachment")
        received = Received(
            key,
            zenoh.ZBytes(data),
            attachment=None if attachment is None else zenoh.ZBytes(attachment),
            stamp=about.get("timestamp") or 0,
        )
        self._put(Reply(self._number, received), size)

    def reply_err(self, data: bytes, encoding: object = None) -> None:
        self._put(Reply(self._number, err=data), len(data))

    def drop(self) -> None:
        if not self._ended:
            self._ended = True
            self._session.hand_over(self._pipe, Rank.ANSWER, Reply(self._number), 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(zenoh.ZError):
            self.drop()

    def _put(self, reply: Reply, size: int) -> None:
        if self._session.is_closed():
            raise zenoh.ZError("session closed")
        self._session.turns.spend(_WORK)
        self._session.hand_over(self._pipe, Rank.ANSWER, reply, size)


class _Token:
    def __init__(self, session: "Session", key: str) -> None:
        self._session, self.key = session, key

    def undeclare(self) -> None:
        self._session.undeclare(self)


class _Liveliness:
    def __init__(self, session: "Session") -> None:
        self._session = session

    def declare_token(self, key: str) -> _Token:
        return self._session.declare(_Token(self._session, key))

    def declare_subscriber(self, *_: object, history: bool) -> object:
        """No other gateway declares tokens."""
        return object()


class _Info:
    def __init__(self, session: "Session") -> None:
        self._session = session

    def declare_transport_events_listener(self, handler: Any, history: bool) -> object:
        self._session.link_listeners.append(handler.callback)
        return object()

    def declare_link_events_listener(self, handler: Any, history: bool) -> object:
        """Links of this network have no addresses."""
        return object()


class _Publisher:
    """A publisher of a key that no client subscribes to."""

    matching = False

    @property
    def matching_status(self) -> "_Publisher":
        return self

    def declare_matching_listener(self, _: object) -> object:
        return object()


class Session:
    """The session of the gateway."""

    def __init__(self, turns: Turns, config: zenoh.Config, number: int) -> None:
        self.turns = turns
        self.limits = _limits(config)
        self.lease = json.loads(config.get_json("transport/link/tx/lease")) / 1000
        self.link_listeners: list[Callable[[LinkEvent], None]] = []
        self.info = _Info(self)
        self.puts: list[Callable[[str, bytes], None]] = []  # taps
        self._number = number
        self._peers: dict[str, Peer] = {}
        self._queryables: list[tuple[str, Callable[[Query], None]]] = []
        self._subscribers: list[tuple[str, Callable[[Received], None]]] = []
        self._tokens: list[_Token] = []
        self._stamps = count(int(turns.loop.time() * 1e9))
        self._closed = False

    # -- the gateway --

    def zid(self) -> str:
        return f"{self._number:032x}"

    def is_closed(self) -> bool:
        return self._closed

    def new_timestamp(self) -> int:
        return next(self._stamps)

    def put(self, key: str, data: bytes, **about: Any) -> None:
        self._publish(key, data, zenoh.SampleKind.PUT, **about)

    def delete(self, key: str, **about: Any) -> None:
        self._publish(key, b"", zenoh.SampleKind.DELETE, **about)

    def declare_queryable(self, key: str, handler: Any, complete: bool) -> object:
        self._queryables.append((key, handler.callback))
        return object()

    def declare_subscriber(self, key: str, handler: Any, allowed_origin: object) -> object:
        self._subscribers.append((key, handler.callback))
        return object()

    def declare_publisher(self, _: str) -> _Publisher:
        return _Publisher()

    def liveliness(self) -> _Liveliness:
        return _Liveliness(self)

    def get(self, _: str, **__: object) -> Iterator[object]:
        """No other gateway answers."""
        return iter(())

    def close(self) -> None:
        self._closed = True
        for peer in [*self._peers.values()]:
            peer.link.close()

    def _publish(self, key: str, data: bytes, kind: zenoh.SampleKind, **about: Any) -> None:
        if self._closed:
            raise zenoh.ZError("session closed")
        self.turns.spend(_WORK)
        for tap in self.puts:
            tap(key, data)
        attachment = about.get("attachment")
        sample = Received(
            key,
            zenoh.ZBytes(data),
            kind,
            None if attachment is None else zenoh.ZBytes(attachment),
            stamp=about["timestamp"],
            put_at=self.turns.loop.time(),
        )
        size = len(key) + (len(data) if "@gateway" not in key else _CONSTANT)
        for peer in [*self._peers.values()]:
            if peer.wants(key):
                peer.pipe.put(Rank.VALUE, sample, size, block=False)

    def declare(self, token: _Token) -> _Token:
        self._tokens.append(token)
        self._tell(Token(token.key, True))
        return token

    def undeclare(self, token: _Token) -> None:
        self._tokens.remove(token)
        self._tell(Token(token.key, False))

    def _tell(self, token: Token) -> None:
        for peer in [*self._peers.values()]:
            self.hand_over(peer.pipe, Rank.CONTROL, token, len(token.key))

    def hand_over(self, pipe: Pipe, rank: Rank, content: Any, size: int) -> None:
        """Puts a message that must not be lost."""
        pipe.put(rank, content, size, block=True)

    # -- the peers --

    def linked(self, peer: Peer) -> None:
        self._peers[peer.zid] = peer
        self._note(peer, zenoh.SampleKind.PUT)
        for token in self._tokens:
            peer.pipe.force(Rank.CONTROL, Token(token.key, True), len(token.key))

    def unlinked(self, peer: Peer) -> None:
        if self._peers.pop(peer.zid, None) is not None:
            peer.pipe.close()
            self._note(peer, zenoh.SampleKind.DELETE)

    def query(
        self,
        peer: Peer,
        number: int,
        selector: str,
        *,
        payload: bytes | None = None,
        attachment: bytes | None = None,
        any_key: bool = False,
    ) -> None:
        query = Query(self, peer, number, selector, payload, attachment, any_key)
        key = selector.partition("?")[0]
        taking = [take for expression, take in self._queryables if matches(expression, key)]
        if taking:
            taking[0](query)
        else:
            peer.pipe.force(Rank.ANSWER, Reply(number), 0)

    def receive(self, key: str, payload: bytes, attachment: bytes | None) -> None:
        attached = None if attachment is None else zenoh.ZBytes(attachment)
        sample = Received(key, zenoh.ZBytes(payload), attachment=attached)
        for expression, take in self._subscribers:
            if matches(expression, key):
                take(sample)

    def _note(self, peer: Peer, kind: zenoh.SampleKind) -> None:
        for listener in self.link_listeners:
            listener(LinkEvent(Transport(peer.zid, peer.whatami), kind))


def _limits(config: zenoh.Config) -> Limits:
    tx = "transport/link/tx"
    batch = json.loads(config.get_json(f"{tx}/batch_size"))
    control, data, low = (
        batch * json.loads(config.get_json(f"{tx}/queue/size/{name}")) for name in _BATCHES
    )
    congestion = f"{tx}/queue/congestion_control"
    drop = json.loads(config.get_json(f"{congestion}/drop/wait_before_drop"))
    close = json.loads(config.get_json(f"{congestion}/block/wait_before_close"))
    return Limits((control, data, low), batch, drop / 1e6, close / 1e6)
