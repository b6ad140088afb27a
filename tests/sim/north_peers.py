"""Clients and routers of the simulated Zenoh network, with links that fail."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import Any

from tests.sim.north_plant import Place
from tests.sim.pipe import Limits, Pipe, Rank
from tests.sim.threads import Turns
from tests.sim.virtual_zenoh import Received, Reply, Session, Token, matches

RETRY = 0.5  # seconds between two attempts of a client to connect
DECLARED = 0.1  # seconds from the link to the declarations of the client: less than 0.3
NUMBERS = count(1)


@dataclass(eq=False)
class Net:
    """The gateway's session of the moment; None while it has none."""

    turns: Turns
    session: Session | None = None

    @property
    def now(self) -> float:
        return self.turns.loop.time()


@dataclass(eq=False)
class Answer:
    """The replies to one query. `ended`: `whole` as far as Zenoh knows, `timeout` or `link`."""

    asked: float
    replies: list[Received] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    failures: list[Any] = field(default_factory=list)  # the documents of the errors
    ended: str = ""
    over: asyncio.Event = field(default_factory=asyncio.Event)

    def end(self, how: str) -> None:
        if not self.ended:
            self.ended = how
            self.over.set()

    @cached_property
    def values(self) -> list[tuple[str, Any]]:
        """The keys and documents; ask when it is over."""
        return [(reply.key_expr, json.loads(reply.payload.to_bytes())) for reply in self.replies]


class Router:
    """A router between the gateway and its clients. It drops values that have no room."""

    whatami = "router"

    def __init__(self, net: Net, name: str, place: Place) -> None:
        self.link = Link(net, self, place)
        self.zid = f"{name}{next(NUMBERS):x}"
        self.clients: list[Client] = []
        self.tokens: dict[str, None] = {}
        self.asked: dict[int, Client] = {}

    @property
    def pipe(self) -> Pipe:
        return self.link.down

    def wants(self, key: str) -> bool:
        return any(client.wants(key) for client in self.clients)

    def received(self, content: Any) -> None:
        match content:
            case Reply(number=number):
                client = self.asked[number]
                if client.link.is_up:
                    client.pipe.force(Rank.ANSWER, content, _size(content))
            case Token(key=key, declared=declared):
                self._token(key, declared=declared)
            case Received(key_expr=key):
                for client in self.clients:
                    if client.wants(key):
                        client.pipe.offer(Rank.VALUE, content, _size(content))

    def closed(self) -> None:
        """The link to the gateway was closed."""
        for key in list(self.tokens):
            self._token(key, declared=False)
        for client in self.clients:
            client.end_answers("whole")  # Zenoh ends the query, as if the gateway had

    def _token(self, key: str, *, declared: bool) -> None:
        if declared:
            self.tokens[key] = None
        else:
            self.tokens.pop(key, None)
        for client in self.clients:
            if client.link.is_up:
                client.pipe.force(Rank.CONTROL, Token(key, declared), len(key))


class Client:
    """A program with a Zenoh session. `at`: its router; None: it is linked to the gateway."""

    whatami = "client"

    def __init__(self, net: Net, name: str, place: Place, at: Router | None = None) -> None:
        self.net, self.name, self.at = net, name, at
        self.link = Link(net, self, place)
        self.zid = f"{name}{next(NUMBERS):x}"
        self.subscribed = ""
        self.take: Callable[[Received], None] = lambda _: None
        self.tokens: dict[str, None] = {}
        self.links = 0  # changes
        self._declared = False
        self._answers: dict[int, Answer] = {}
        if at is not None:
            at.clients.append(self)

    @property
    def pipe(self) -> Pipe:
        return self.link.down

    def wants(self, key: str) -> bool:
        return self._declared and bool(self.subscribed) and matches(self.subscribed, key)

    def connected(self) -> None:
        self.links += 1
        for token in self.at.tokens if self.at is not None else ():
            self.pipe.force(Rank.CONTROL, Token(token, True), len(token))
        self.net.turns.loop.call_later(DECLARED, self._declare, self.links)

    def _declare(self, links: int) -> None:
        self._declared = self.link.is_up and self.links == links

    def closed(self) -> None:
        self.links += 1
        self._declared = False
        self.tokens.clear()
        self.end_answers("link")

    def leave(self) -> None:
        """Ends the program; another one starts later."""
        self.link.close()
        self.zid = f"{self.name}{next(NUMBERS):x}"

    def received(self, content: Any) -> None:
        match content:
            case Reply(number=number, ok=ok, err=err) if number in self._answers:
                answer = self._answers[number]
                if ok is not None:
                    answer.replies.append(ok)
                elif err is not None:
                    answer.failures.append(json.loads(err))
                    answer.errors.append(answer.failures[-1]["error"])
                else:
                    answer.end("whole")
            case Token(key=key, declared=True):
                self.tokens[key] = None
            case Token(key=key):
                self.tokens.pop(key, None)
            case Received():
                self.take(content)

    def end_answers(self, how: str) -> None:
        for answer in self._answers.values():
            answer.end(how)

    async def get(
        self,
        selector: str,
        timeout: float = 10.0,
        *,
        payload: bytes | None = None,
        attachment: bytes | None = None,
        any_key: bool = False,
        arrived: Callable[[], None] = lambda: None,
    ) -> Answer:
        """Queries the gateway. `arrived` is called when the query does."""
        number, answer = next(NUMBERS), Answer(self.net.now)
        if not self.link.is_up:
            answer.end("link")
            return answer
        self._answers[number] = answer

        def ask(session: Session) -> None:
            arrived()
            peer: Any = self.at or self
            about: Any = {"payload": payload, "attachment": attachment, "any_key": any_key}
            session.query(peer, number, selector, **about)

        self._send(number, ask, len(selector) if "after=" not in selector else 200)
        try:
            async with asyncio.timeout(timeout):
                await answer.over.wait()
        except TimeoutError:
            answer.end("timeout")
        del self._answers[number]
        return answer

    def put(
        self, key: str, payload: bytes, arrived: Callable[[], None], attachment: bytes | None = None
    ) -> None:
        def write(session: Session) -> None:
            arrived()
            session.receive(key, payload, attachment)

        if self.link.is_up:
            self._send(0, write, len(key))

    def _send(self, number: int, act: Callable[[Session], None], size: int) -> None:
        def pass_on(_: object = None) -> None:
            if self.at is None:
                _act(self.net, act)
            elif self.at.link.is_up:
                self.at.asked[number] = self
                self.at.link.up.force(Rank.ANSWER, act, size)

        self.link.up.force(Rank.ANSWER, pass_on, size)


class Link:
    """The link of a client or router: to the gateway, or to the router of the client."""

    def __init__(self, net: Net, peer: Any, place: Place) -> None:
        self.rate = place.rate
        self.is_up = False
        self.barred = 0  # causes for which it cannot be opened
        self.held = 0  # causes for which nothing passes
        self.since = float("-inf")  # the last change
        self._lost = 0, float("-inf")  # messages, and when the last: of earlier connections
        self._net, self._peer, self._place = net, peer, place
        self.down: Pipe
        self.up: Pipe

    @property
    def _at(self) -> Any:
        return getattr(self._peer, "at", None)

    @property
    def lost(self) -> tuple[int, float]:
        """Values that had no room, and the time of the last."""
        if not self.is_up:
            return self._lost
        return self._lost[0] + self.down.lost, max(self._lost[1], self.down.lost_at)

    async def keep_open(self) -> None:
        while True:
            if not (self.is_up or self.barred or self.held):
                self._open()
            await asyncio.sleep(RETRY)

    def _open(self) -> None:
        session, peer = self._net.session, self._peer
        if self._at is not None and not self._at.link.is_up:
            return
        if session is None or session.is_closed():
            return
        self.down = self._pipe(session.limits, peer.received)
        self.up = self._pipe(session.limits, lambda act: _act(self._net, act))
        self.is_up, self.since = True, self._net.now
        if isinstance(peer, Client):
            peer.connected()
        if self._at is None:
            session.linked(peer)

    def _pipe(self, limits: Limits, deliver: Callable[[Any], None]) -> Pipe:
        rate, latency, buffer, _ = self._place
        return Pipe(self._net.turns, limits, rate, latency, buffer, deliver, self.close)

    def close(self) -> None:
        """Closes both ends at once."""
        if not self.is_up:
            return
        self._lost = self.lost
        self.is_up, self.since = False, self._net.now
        self.down.close()
        self.up.close()
        session = self._net.session
        if self._at is None and session is not None:
            session.unlinked(self._peer)
        self._peer.closed()

    def set_rate(self, factor: float) -> None:
        """`factor` 0: nothing passes."""
        if self.is_up:
            self.down.set_rate(self.rate * factor)
            self.up.set_rate(self.rate * factor)


def _act(net: Net, act: Callable[[Session], None]) -> None:
    if net.session is not None and not net.session.is_closed():
        act(net.session)


def _size(content: Any) -> int:
    match content:
        case Reply(ok=None, err=err):
            return len(err or b"")
        case Reply(ok=received):
            return _size(received)
        case Received(key_expr=key) if "@gateway" in key:
            return 300
        case Received(key_expr=key, payload=payload):
            return len(key) + len(payload.to_bytes())
    return 0
