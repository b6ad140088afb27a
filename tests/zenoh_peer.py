"""A Zenoh router, peer or client in another process, controlled by a test.

In a test:

    async with ZenohPeer(Mode.ROUTER, listen=[endpoint]) as router: ...
    async with ZenohPeer("client", connect=[endpoint]) as client:
        values = await client.subscribe("plant/**")            # a Subscription: its samples
        await values.next(lambda s: s.key == "plant/mixer/speed" and s.json["value"] == 12)
        replies = await client.get("plant/mixer/*")            # list of Reply
        [reply] = await client.get("plant/mixer/recipe/@set", b"7")
        replies = await client.many([("plant/mixer/recipe/@set", b"7")] * 1000)   # all at once
        await client.put("plant/mixer/recipe/@set", b"7")
        await client.delete("plant/mixer/recipe/@set")
        tokens = await client.liveliness("plant/@gateway/**")  # a Subscription: PUT and DELETE
        await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])  # no others
        await client.kill()                                    # SIGKILL; other signals by `.pid`

`subscribe(key, advanced=True)` is Zenoh's AdvancedSubscriber with history.

The script exchanges JSON lines: `{"n": 1, "do": "get", …}` in, `{"n": 1, "result": …}` or
`{"n": 1, "error": "…"}` out, and `{"received": <subscription>, …}` for every sample. Payloads are
base64. It ends with its standard input.
"""

import asyncio
import atexit
import base64
import itertools
import json
import os
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh
from zenoh import ext

TIMEOUT = 300.0  # seconds; never waited for when all is well
ANSWER_WITHIN = 20.0  # seconds for the replies to one query
POLL = 0.03  # seconds between two queries for what is not there yet: three processes would spin
# A query that every gateway answers. Zenoh does not wait for a declaration to arrive, but earlier
# declarations go the same way before the query.
BARRIER = "*/@gateway/*/status"


# Ports below those that the system gives to connections. Each process of the tests has a block of
# its own, beside those of another run on this machine: it keeps the first port of the block.
FIRST_PORT, BLOCK, BLOCKS = 12_000, 400, 50


@cache
def _own_ports() -> "itertools.cycle[int]":
    """Returns the ports of this process, again and again."""
    for number in range(os.getpid(), os.getpid() + BLOCKS):
        first = FIRST_PORT + number % BLOCKS * BLOCK
        claim = socket.socket()
        atexit.register(claim.close)
        with suppress(OSError):
            claim.bind(("127.0.0.1", first))
            return itertools.cycle(range(first + 1, first + BLOCK))
    raise AssertionError("every block of ports belongs to another process")


def free_port(neighbours: int = 1) -> int:
    """Returns a free port of the loopback that this process has not used recently; the first of
    so many neighbours."""
    assert neighbours < BLOCK, "the ports of this process are fewer"
    ports = _own_ports()
    while True:
        found = [next(ports) for _ in range(neighbours)]
        if found[-1] - found[0] == neighbours - 1 and all(map(_is_free, found)):
            return found[0]


def _is_free(port: int) -> bool:
    with socket.socket() as probe, suppress(OSError):
        probe.bind(("127.0.0.1", port))
        return True
    return False


def free_endpoint() -> str:
    """Returns a loopback endpoint with a free port."""
    return f"tcp/127.0.0.1:{free_port()}"


# -- the test's side ---------------------------------------------------------------------------


class Received(NamedTuple):
    """One sample; `time` is Zenoh's time stamp in ns, `kind` is PUT or DELETE."""

    key: str
    kind: str
    payload: bytes
    encoding: str
    time: int | None
    attachment: bytes = b""

    @property
    def json(self) -> Any:
        return _parsed(self.payload)


class Reply(NamedTuple):
    """One reply; an error has no key."""

    ok: bool
    key: str | None
    payload: bytes
    encoding: str
    time: int | None

    @property
    def json(self) -> Any:
        return _parsed(self.payload)


class Subscription:
    """The samples of one subscription in the order of arrival; `samples` holds all of them."""

    def __init__(self) -> None:
        self.samples: list[Received] = []
        self._arrived = asyncio.Event()

    def feed(self, sample: Received) -> None:
        self.samples.append(sample)
        self._arrived.set()

    def latest(self) -> dict[str, Received]:
        """By key."""
        return {sample.key: sample for sample in self.samples}

    async def next(self, fits: Callable[[Received], bool], timeout: float = TIMEOUT) -> Received:
        """Returns the first sample that fits, of those since `forget`; waits for it."""
        seen = 0
        async with asyncio.timeout(timeout):
            while True:
                for sample in self.samples[seen:]:
                    if fits(sample):
                        return sample
                seen = len(self.samples)
                self._arrived.clear()
                await self._arrived.wait()

    async def until(self, done: Callable[["Subscription"], bool], timeout: float = TIMEOUT) -> None:
        """Waits until `done(self)`, checked after every arrival."""
        async with asyncio.timeout(timeout):
            while not done(self):
                self._arrived.clear()
                await self._arrived.wait()

    def forget(self) -> None:
        self.samples.clear()


class ZenohPeer:
    """The other process. An async context manager; `config` is Zenoh's own, {path: value}."""

    def __init__(
        self,
        mode: str,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        config: dict[str, Any] | None = None,
    ) -> None:
        self.config = config or {}
        self.connect = list(connect)
        self._mode = str(mode)
        self._listen = list(listen)
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._subscriptions: dict[int, Subscription] = {}
        self._count = 0

    async def __aenter__(self) -> Self:
        setup = {
            "mode": self._mode,
            "listen": self._listen,
            "connect": self.connect,
            "config": self.config,
        }
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            str(Path(__file__)),
            json.dumps(setup),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=64 * 1024 * 1024,
        )
        self._reader = asyncio.create_task(self._read())
        try:
            await self._request("hello")
        except BaseException:
            await self.kill()  # `__aexit__` is not called after an exception here
            raise
        return self

    async def __aexit__(self, *_error: object) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._reader is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(5):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
        await self._reader

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    async def kill(self) -> None:
        assert self._process is not None
        with suppress(ProcessLookupError):  # it has ended already
            self._process.kill()
        await self._process.wait()

    async def subscribe(self, key: str, *, advanced: bool = False) -> Subscription:
        """Returns when every reachable gateway knows the subscription."""
        subscription = await self._subscribe("subscribe", key=key, advanced=advanced)
        await self.get(BARRIER)
        return subscription

    async def queryable(self, key: str) -> Subscription:
        """Receives queries, as samples, and answers none."""
        return await self._subscribe("queryable", key=key)

    async def declare_token(self, key: str) -> None:
        await self._request("token", key=key)

    async def liveliness(self, key: str) -> Subscription:
        """Observes tokens: declared (PUT, also before) and undeclared (DELETE)."""
        return await self._subscribe("liveliness", key=key)

    async def tokens(self, key: str) -> list[str]:
        """Returns the tokens. Zenoh 1.10.2 sometimes answers nothing just after a token was
        declared: see `until_alive`."""
        result: list[str] = await self._request("tokens", key=key)
        return result

    async def until_alive(self, key: str, tokens: list[str], timeout: float = TIMEOUT) -> None:
        """Waits until exactly these tokens are declared under `key`."""
        async with asyncio.timeout(timeout):
            while await self.tokens(key) != tokens:
                await asyncio.sleep(POLL)

    async def get(
        self,
        selector: str,
        payload: bytes | None = None,
        timeout: float = ANSWER_WITHIN,
        attachment: bytes | None = None,
        **options: str,
    ) -> list[Reply]:
        """Sends one query. `options`: `target="ALL"`, `consolidation="NONE"`,
        `accept_replies="ANY"`, `encoding="application/cbor"`."""
        if attachment is not None:
            options["attachment"] = base64.b64encode(attachment).decode()
        [replies] = await self.many([(selector, payload)], timeout, **options)
        return replies

    async def get_until(self, selector: str, fits: Callable[[Any], bool]) -> Any:
        """Waits until the one document is there and fits: a gateway that has just started does not
        reply for a device before its claim counts."""
        async with asyncio.timeout(TIMEOUT):
            while True:
                for reply in await self.get(selector):
                    if fits(reply.json):
                        return reply.json
                await asyncio.sleep(POLL)

    async def get_all_until(
        self, selector: str, fit: Callable[[dict[str, Any]], bool]
    ) -> dict[str, Any]:
        """Waits until the documents by key fit, and returns them: those of tags that were not read
        yet say so."""
        async with asyncio.timeout(TIMEOUT):
            while True:
                replies = await self.get(selector, consolidation="NONE")
                found = {reply.key: reply.json for reply in replies if reply.key is not None}
                if fit(found):
                    return found
                await asyncio.sleep(POLL)

    async def many(
        self,
        queries: Sequence[tuple[str, bytes | None]],
        timeout: float = ANSWER_WITHIN,
        **options: str,
    ) -> list[list[Reply]]:
        """Sends all queries at once. Returns the replies of each, in the order of the queries."""
        encoded = [(selector, _text(payload)) for selector, payload in queries]
        result = await self._request("get", queries=encoded, timeout=timeout, options=options)
        return [
            [Reply(ok, key, base64.b64decode(data), *rest) for ok, key, data, *rest in replies]
            for replies in result
        ]

    async def put(
        self,
        key: str,
        payload: bytes,
        attachment: bytes | None = None,
        times: int = 1,
        encoding: str = "zenoh/bytes",
    ) -> None:
        sent = {"payload": _text(payload), "attachment": _text(attachment), "times": times}
        sent["encoding"] = encoding
        await self._request("put", key=key, **sent)

    async def delete(self, key: str) -> None:
        await self._request("delete", key=key)

    async def _subscribe(self, do: str, **arguments: Any) -> Subscription:
        subscription = Subscription()
        self._subscriptions[self._count + 1] = subscription
        await self._request(do, **arguments)
        return subscription

    async def _request(self, do: str, **arguments: Any) -> Any:
        assert self._process is not None
        assert self._process.stdin is not None
        self._count += 1
        n = self._count
        self._pending[n] = answer = asyncio.get_running_loop().create_future()
        line = json.dumps({"n": n, "do": do, **arguments})
        self._process.stdin.write(line.encode() + b"\n")
        await self._process.stdin.drain()
        async with asyncio.timeout(TIMEOUT):
            return await answer

    async def _read(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            message = json.loads(line)
            if "received" in message:
                key, kind, data, encoding, time, token = message["sample"]
                self._subscriptions[message["received"]].feed(
                    Received(
                        key,
                        kind,
                        base64.b64decode(data),
                        encoding,
                        time,
                        base64.b64decode(token),
                    )
                )
            elif (answer := self._pending.pop(message["n"])).done():
                pass  # the test has given up
            elif "error" in message:
                answer.set_exception(RuntimeError(message["error"]))
            else:
                answer.set_result(message["result"])
        for answer in self._pending.values():
            if not answer.done():
                answer.set_exception(ConnectionError("the Zenoh peer has ended"))


def _parsed(payload: bytes) -> Any:
    try:
        return json.loads(payload)
    except ValueError as error:
        raise AssertionError(f"this is no JSON: {payload[:1000]!r}") from error


def _text(payload: bytes | None) -> str | None:
    return None if payload is None else base64.b64encode(payload).decode()


# -- the other process -------------------------------------------------------------------------

_stdout = threading.Lock()


def _send(message: dict[str, Any]) -> None:
    line = json.dumps(message) + "\n"
    with _stdout:
        sys.stdout.write(line)
        sys.stdout.flush()


def _forward(n: int) -> Callable[[zenoh.Sample], None]:
    return lambda sample: _send({"received": n, "sample": _flat(sample)})


def _overhear(n: int) -> Callable[[zenoh.Query], None]:
    def taken(query: zenoh.Query) -> None:
        with query:
            data, attached = query.payload, query.attachment
            texts = [_text(b"" if found is None else bytes(found)) for found in (data, attached)]
            flat = [str(query.key_expr), "QUERY", texts[0], "", None, texts[1]]
            _send({"received": n, "sample": flat})

    return taken


def _flat(sample: zenoh.Sample) -> list[Any]:
    stamp = sample.timestamp
    return [
        str(sample.key_expr),
        str(sample.kind).rpartition(".")[2],
        _text(bytes(sample.payload)),
        str(sample.encoding),
        None if stamp is None else stamp.get_time_as_ntp64().as_nanos(),
        _text(b"" if sample.attachment is None else bytes(sample.attachment)),
    ]


def _reply(answer: zenoh.Reply) -> list[Any]:
    if answer.ok is not None:
        key, _, data, encoding, time, _ = _flat(answer.ok)
        return [True, key, data, encoding, time]
    assert answer.err is not None
    return [False, None, _text(bytes(answer.err.payload)), str(answer.err.encoding), None]


def _bytes_of(text: str | None) -> bytes | None:
    return None if text is None else base64.b64decode(text)


def _get(
    session: zenoh.Session,
    queries: list[tuple[str, str | None]],
    timeout: float,
    extra: dict[str, str],
) -> list[list[Any]]:
    options: dict[str, Any] = {"timeout": timeout}
    if "target" in extra:
        options["target"] = getattr(zenoh.QueryTarget, extra["target"])
    if "consolidation" in extra:
        options["consolidation"] = getattr(zenoh.ConsolidationMode, extra["consolidation"])
    if "accept_replies" in extra:
        options["accept_replies"] = getattr(zenoh.ReplyKeyExpr, extra["accept_replies"])
    if "attachment" in extra:
        options["attachment"] = _bytes_of(extra["attachment"])
    if "encoding" in extra:
        options["encoding"] = zenoh.Encoding(extra["encoding"])
    found: list[list[zenoh.Reply]] = [[] for _ in queries]
    ends = [threading.Event() for _ in queries]
    for (selector, payload), replies, end in zip(queries, found, ends, strict=True):
        handler = zenoh.handlers.Callback(replies.append, end.set, indirect=False)
        session.get(selector, handler, payload=_bytes_of(payload), **options)
    for end in ends:
        end.wait()
    return [[_reply(answer) for answer in replies] for replies in found]


def _declare(session: zenoh.Session, request: dict[str, Any]) -> object:
    live, key, n = session.liveliness(), request["key"], request["n"]
    match request["do"]:
        case "queryable":
            return session.declare_queryable(key, _overhear(n), complete=False)
        case "token":
            return live.declare_token(key)
        case "liveliness":
            return live.declare_subscriber(key, _forward(n), history=True)
    if not request["advanced"]:
        return session.declare_subscriber(key, _forward(n))
    history = ext.HistoryConfig(max_samples=1)
    return ext.declare_advanced_subscriber(session, key, _forward(n), history=history)


def _execute(session: zenoh.Session, kept: list[object], request: dict[str, Any]) -> Any:
    match request:
        case {"do": "hello"}:
            return str(session.zid())
        case {"do": "subscribe" | "queryable" | "token" | "liveliness"}:
            kept.append(_declare(session, request))
        case {"do": "tokens", "key": key}:
            found = session.liveliness().get(key, timeout=2)
            return sorted(str(answer.ok.key_expr) for answer in found if answer.ok)
        case {"do": "get", "queries": queries, "timeout": timeout, "options": options}:
            return _get(session, queries, timeout, options)
        case {"do": "put", "key": key, "payload": payload, "attachment": attachment}:
            block = zenoh.CongestionControl.BLOCK
            data, token = _bytes_of(payload) or b"", _bytes_of(attachment)
            encoding = zenoh.Encoding(request["encoding"])
            for _ in range(request["times"]):
                session.put(
                    key, data, encoding=encoding, congestion_control=block, attachment=token
                )
        case {"do": "delete", "key": key}:
            session.delete(key)
        case _:
            raise ValueError(f"no such command: {request}")
    return None


def configured(setup: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": setup["mode"],
        "listen/endpoints": setup["listen"],
        "connect/endpoints": setup["connect"],
        "connect/timeout_ms": 5000,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 400,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/autoconnect": [],
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 50_000,
        **setup["config"],
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def main() -> None:
    kept: list[object] = []
    with zenoh.open(configured(json.loads(sys.argv[1]))) as session:
        for line in sys.stdin:
            request = json.loads(line)
            try:
                _send({"n": request["n"], "result": _execute(session, kept, request)})
            except (zenoh.ZError, ValueError) as error:
                _send({"n": request["n"], "error": str(error)})


if __name__ == "__main__":
    main()
