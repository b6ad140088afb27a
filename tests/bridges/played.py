"""A gateway as the bridges see it on Zenoh, played by a test."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any, Self

import zenoh

from tests.zenoh_peer import configured, free_endpoint

META: dict[str, Any] = {
    "type": "int16",
    "unit": "",
    "description": "",
    "history": False,
    "payload": "json",
    "write": None,
}


def document(value: object, reason: str = "") -> dict[str, Any]:
    """Returns a value as the gateway publishes it; with a reason it is bad."""
    time = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    if reason:
        return {"value": None, "quality": "bad", "reason": reason, "time": time}
    return {"value": value, "quality": "good", "time": time}


@asynccontextmanager
async def answered(key: str, answer: Callable[[zenoh.Query], None]) -> AsyncIterator[zenoh.Session]:
    """A session, beside a program that answers every query of these keys."""
    endpoint = free_endpoint()
    here = {"mode": "peer", "listen": [endpoint], "connect": [], "config": {}}
    there = {"mode": "client", "listen": [], "connect": [endpoint], "config": {}}

    def reply(query: zenoh.Query) -> None:
        with query:
            answer(query)

    with zenoh.open(configured(here)) as other:
        other.declare_queryable(key, reply)
        with await asyncio.to_thread(zenoh.open, configured(there)) as session:
            yield session


class PlayedGateway:
    """The gateway `demo` under `plant`. All devices answer; all values are `starting`.

    `documents` are its values. `answer` is the reply to a write: `written`, another outcome,
    `silent`, or `held` for ever.
    """

    def __init__(
        self, endpoint: str, tags: dict[str, dict[str, Any]], mode: str = "listen"
    ) -> None:
        self.answer = "written"
        self.written: list[tuple[str, Any]] = []
        self._news = threading.Condition()
        self._held: list[zenoh.Query] = []
        self._tags = {key: META | about for key, about in tags.items()}
        self.documents = {key: document(None, "starting") for key in tags}
        ends: dict[str, Any] = {"listen": [], "connect": [], "config": {}}
        setup = {"mode": "peer", **ends, mode: [endpoint]}
        self._session = zenoh.open(configured(setup))
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._answering: list[Any] = []
        self.arrive()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends as a killed gateway does: its links go."""
        self._session.close()  # type: ignore[no-untyped-call]

    def arrive(self) -> None:
        declare = self._session.declare_queryable
        self._answering = [
            declare("plant/**", self._value),
            declare("plant/**/@meta", self._meta),
            declare("plant/**/@set", self._set),
        ]
        self._declare("", "plant/@gateway/demo")
        for device in {key.partition("/")[0] for key in self._tags}:
            self.online(device)

    def leave(self) -> None:
        """Ends, but its links stay: those of a router."""
        declared: list[Any] = [*self._tokens.values(), *self._answering]
        for one in declared:
            one.undeclare()
        self._tokens.clear()

    def online(self, device: str) -> None:
        self._declare(device, f"plant/@gateway/demo/alive/{device}")

    def offline(self, device: str) -> None:
        self._tokens.pop(device).undeclare()  # type: ignore[no-untyped-call]

    def _declare(self, name: str, token: str) -> None:
        self._tokens[name] = self._session.liveliness().declare_token(token)

    def put(self, key: str, value: object, reason: str = "") -> None:
        self.documents[key] = document(value, reason)
        self._session.put(f"plant/{key}", *self._payload(key)[:1], attachment=self._payload(key)[1])

    def block(self, device: str, **values: object) -> None:
        self.documents |= {f"{device}/{tag}": document(value) for tag, value in values.items()}
        known = {tag: self.documents[f"{device}/{tag}"] for tag in values}
        self._session.put(f"plant/{device}/@block", json.dumps(known))

    def until_written(self, count: int) -> None:
        """Waits for so many writes."""
        with self._news:
            assert self._news.wait_for(lambda: len(self.written) >= count, 300), self.written

    def _payload(self, key: str) -> tuple[str, str | None]:
        known = self.documents[key]
        if self._tags[key]["payload"] == "raw" and known["quality"] == "good":
            about = {name: item for name, item in known.items() if name != "value"}
            return str(known["value"]), json.dumps(about)
        return json.dumps(known), None

    # -- Zenoh's threads --

    def _value(self, query: zenoh.Query) -> None:
        with query:
            for key in self._tags:
                payload, about = self._payload(key)
                query.reply(f"plant/{key}", payload, attachment=about)

    def _meta(self, query: zenoh.Query) -> None:
        with query:
            for key, about in self._tags.items():
                if query.key_expr.intersects(zenoh.KeyExpr(f"plant/{key}/@meta")):
                    query.reply(f"plant/{key}/@meta", json.dumps(about))

    def _set(self, query: zenoh.Query) -> None:
        key = str(query.key_expr).removeprefix("plant/").removesuffix("/@set")
        assert query.payload is not None
        value = json.loads(query.payload.to_bytes())
        if self.answer == "held":
            self._held.append(query)
        else:
            with query:
                self._reply(query, value)
        with self._news:
            self.written.append((key, value))
            self._news.notify_all()

    def _reply(self, query: zenoh.Query, value: object) -> None:
        if self.answer == "written":
            query.reply(query.key_expr, json.dumps({"value": value, "verified": False}))
        elif self.answer != "silent":
            failed = {"error": self.answer, "reason": "as the test says"}
            json_text = zenoh.Encoding.APPLICATION_JSON
            query.reply_err(json.dumps(failed), encoding=json_text)
