"""The command line as a Zenoh client of a running gateway."""

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from queue import SimpleQueue
from typing import NamedTuple

import orjson
import zenoh

from gateway.config import Config
from gateway.control import TO_ALL
from gateway.errors import ConfigError, GatewayError
from gateway.keys import Keys
from gateway.northbound import Mode, zenoh_settings
from gateway.northbound.session import configure
from gateway.payload import rfc3339
from gateway.values import Value

TOKEN_VARIABLE = "PLC_GATEWAY_WRITE_TOKEN"  # noqa: S105  (the name of a variable)
PATIENCE = 10.0  # seconds a question may take
NOTHING = "nothing was answered: is the gateway of this file running?"


class Shown(NamedTuple):
    """A sample as it arrived: `document` is the decoded payload."""

    tag: str  # device/name
    document: dict[str, object]


class Client:
    """One session to the gateway of a configuration. Blocking calls, for the command line only."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session = session
        self._keys = keys

    def values(self, wanted: str, max_age: str | None = None) -> list[Shown]:
        """The current values of the tags a key expression (without the prefix) names."""
        selector = self._keys.value(wanted) + (f"?max_age={max_age}" if max_age else "")
        found = []
        for reply in self._ask(selector, None):
            if reply.err is not None:
                raise GatewayError(_reason(reply.err.payload.to_bytes()))
            if reply.ok is not None and (shown := self._shown(reply.ok)) is not None:
                found.append(shown)
        return sorted(found)

    def status(self, path: str = "status") -> dict[str, object]:
        """`status`, `lines/<line>` or `devices/<device>` of the gateway."""
        for reply in self._ask(self._keys.status(path), None):
            if reply.ok is not None:
                return _document(reply.ok.payload.to_bytes())
        raise GatewayError("the gateway does not answer")

    def write(self, tag: str, value: Value) -> dict[str, object]:
        """The outcome as the gateway told it: `value ...` or `error ...`.

        Raises `GatewayError` when nobody answered: then nobody knows whether it was done.
        """
        token = os.environ.get(TOKEN_VARIABLE)
        replies = self._ask(self._keys.set(tag), orjson.dumps(value), token)
        for reply in replies:
            answer = reply.ok or reply.err
            if answer is not None:
                return _document(answer.payload.to_bytes())
        raise GatewayError(f"no gateway answered for {tag}: is it running?")

    def control(self, line: str, device: str, command: str, argument: str) -> dict[str, object]:
        """What the device said: `answer ...` or `error ...`. Raises as `write`."""
        to_all = command == TO_ALL
        key = self._keys.to_all(line) if to_all else self._keys.command(device, command)
        for reply in self._ask(key, argument.encode(), os.environ.get(TOKEN_VARIABLE)):
            answer = reply.ok or reply.err
            if answer is not None:
                return _document(answer.payload.to_bytes())
        raise GatewayError(f"no gateway answered at {key}: is it running?")

    def follow(self, wanted: Sequence[str]) -> Iterator[Shown]:
        """The current values, then every change as it comes, without end.

        When the gateway goes, what was good is bad: `no-gateway`; when it returns, its values
        are asked for again. Raises `GatewayError` when there is none to begin with.
        """
        news: SimpleQueue[Shown | bool] = SimpleQueue()
        seen: set[str] = set()
        with ExitStack() as stack:
            for want in wanted:
                stack.enter_context(self._subscribed(want, news.put))
            for watcher in self._gateway_seen(news.put):
                stack.enter_context(watcher)
            rows = self._all(wanted)
            if not rows:
                raise GatewayError(NOTHING)
            there = True
            while True:
                seen.update(row.tag for row in rows)
                yield from rows
                match news.get():
                    case True:  # what arrives meanwhile is newer, and handed on after this
                        there = True
                        try:
                            rows = self._all(wanted)
                        except GatewayError:
                            rows = []
                            news.put(True)
                    case False:
                        there = False
                        rows = [_lost(tag) for tag in sorted(seen)]
                    case row:  # without a gateway it is one that came late
                        rows = [row] if there else []

    def _all(self, wanted: Sequence[str]) -> list[Shown]:
        return [row for want in wanted for row in self.values(want)]

    def _subscribed(self, wanted: str, told: Callable[[Shown], None]) -> zenoh.Subscriber[None]:
        def arrived(sample: zenoh.Sample) -> None:
            got = self._shown(sample)
            if got is not None:
                told(got)

        return self._session.declare_subscriber(self._keys.value(wanted), arrived)

    def _gateway_seen(
        self, told: Callable[[bool], None]
    ) -> tuple[AbstractContextManager[object], ...]:
        """True when the gateway comes, False when it goes, or the only link to it."""

        def token(sample: zenoh.Sample) -> None:
            told(sample.kind == zenoh.SampleKind.PUT)

        def link(event: zenoh.TransportEvent) -> None:
            if event.kind == zenoh.SampleKind.DELETE:  # when it is back, the token says so
                told(False)

        return (
            self._session.liveliness().declare_subscriber(self._keys.own, token),
            self._session.info.declare_transport_events_listener(link),
        )

    def _ask(
        self, selector: str, payload: bytes | None, token: str | None = None
    ) -> list[zenoh.Reply]:
        try:
            return list(
                self._session.get(
                    selector,
                    payload=payload,
                    attachment=token,
                    timeout=PATIENCE,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )
            )
        except zenoh.ZError as error:
            raise GatewayError(f"{selector}: {error}") from None

    def _shown(self, sample: zenoh.Sample) -> Shown | None:
        tag = self._keys.tag(str(sample.key_expr))
        with suppress(orjson.JSONDecodeError):
            if tag is not None and sample.attachment is not None:
                return Shown(tag, _raw(sample, sample.attachment.to_bytes()))
            if tag is not None and sample.kind == zenoh.SampleKind.PUT:
                return Shown(tag, _document(sample.payload.to_bytes()))
        return None


@contextmanager
def connected(config: Config) -> Iterator[Client]:
    """A client of the gateway that `config` describes. Raises `GatewayError` when none is there."""
    own = config.zenoh
    endpoints = own.connect if own.mode == "client" else own.listen or own.connect
    if not endpoints:
        raise GatewayError("zenoh.listen and zenoh.connect are empty: no way to the gateway")
    settings = replace(
        zenoh_settings(own),
        mode=Mode.CLIENT,
        listen=(),
        connect=tuple(_reachable(endpoint) for endpoint in endpoints),
        users_file=None,
    )
    setup = configure(settings)
    setup.insert_json5("listen/endpoints", "[]")
    try:
        session = zenoh.open(setup)
    except zenoh.ZError:
        raise GatewayError(
            f"no gateway at {', '.join(settings.connect)}: start it with `plc-gateway run`, "
            "or use --direct"
        ) from None
    try:
        yield Client(session, Keys(own.prefix, config.name))
    finally:
        session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def wanted_keys(config: Config, names: list[str] | None) -> list[str]:
    """The key expressions of what was named: tags, devices, wildcards. Raises `ConfigError`."""
    if not names:
        return ["**"]
    known = [tag.key for device in config.devices for tag in device.tags]
    devices = {device.name for device in config.devices}
    wanted = []
    for name in names:
        if name in devices:
            name = f"{name}/**"
        try:
            found = any(matches(key, [name]) for key in known)
        except zenoh.ZError:
            raise ConfigError(f"{name} is no tag, and no wildcard such as 'mixer/**'") from None
        if not found:
            raise ConfigError(f"there is no tag or device {name}")
        wanted.append(name)
    return wanted


def matches(key: str, wanted: list[str]) -> bool:
    """Raises `ZError` for what is no key expression."""
    return any(zenoh.KeyExpr(want).intersects(zenoh.KeyExpr(key)) for want in wanted)


def parse_value(text: str) -> Value:
    """A value as typed in a shell: a JSON scalar (`true`, `12.5`, `"AB"`), or else text."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    if isinstance(value, float) and not math.isfinite(value):
        return text  # NaN and 1e999 are no JSON
    return value if isinstance(value, (bool, int, float, str)) else text


def _lost(tag: str) -> Shown:
    """Nobody knows the value any more."""
    now = rfc3339(time.time_ns())
    return Shown(tag, {"value": None, "quality": "bad", "reason": "no-gateway", "time": now})


def _reachable(endpoint: str) -> str:
    """An endpoint that listens everywhere is reached on this machine."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def _raw(sample: zenoh.Sample, about: bytes) -> dict[str, object]:
    """What a tag with `payload: raw` says, as the others say it."""
    known = sample.kind == zenoh.SampleKind.PUT
    text = sample.payload.to_bytes().decode("utf-8", "replace")
    return {"value": parse_value(text) if known else None, **_document(about)}


def _document(data: bytes) -> dict[str, object]:
    found = orjson.loads(data)
    return found if isinstance(found, dict) else {"value": found}


def _reason(data: bytes) -> str:
    with suppress(orjson.JSONDecodeError):
        return str(_document(data).get("reason", data.decode("utf-8", "replace")))
    return data.decode("utf-8", "replace")
