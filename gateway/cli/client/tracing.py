"""Follows the trace of a line: the gateway publishes it while this client subscribes."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

import orjson
import zenoh

from gateway.cli.client.rows import document
from gateway.contract.keys import Keys

LOOK_EVERY = 0.5  # seconds; Ctrl-C does not interrupt a wait without end


def traced(
    session: zenoh.Session,
    keys: Keys,
    line: str,
    until: float | None,
    served: Callable[[], object],
    tell: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    """Yields the documents of a trace. `until`: by the monotonic clock; None: without end.

    `served` raises `GatewayError` when no gateway has the line. `tell` gets sentences for people.
    """
    news: SimpleQueue[dict[str, Any] | str] = SimpleQueue()

    def arrived(sample: zenoh.Sample) -> None:
        with suppress(orjson.JSONDecodeError):
            news.put(document(sample.payload.to_bytes()))

    def token(sample: zenoh.Sample) -> None:
        here = sample.kind == zenoh.SampleKind.PUT
        news.put("the gateway is here again" if here else "the gateway has gone; waiting for it")

    with (
        session.declare_subscriber(keys.trace(line), arrived),
        session.liveliness().declare_subscriber(keys.own, token),
    ):
        served()
        while until is None or time.monotonic() < until:
            left = LOOK_EVERY if until is None else min(LOOK_EVERY, until - time.monotonic())
            with suppress(Empty):
                event = news.get(timeout=max(0.0, left))
                if isinstance(event, str):
                    tell(event)
                else:
                    yield event
