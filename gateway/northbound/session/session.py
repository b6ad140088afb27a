"""The Zenoh session: opened and closed without blocking the event loop."""

import asyncio
import errno
import json
import os
from contextlib import suppress
from typing import TypeVar

import structlog
import zenoh

from gateway.errors import GatewayError
from gateway.plant.threads import off_loop

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

T = TypeVar("T")
CLOSE_WITHIN = 2.0  # seconds
# Zenoh reads the variable when it opens its first session. By default one thread sends on all
# links: a link that is closed while answers wait for it holds up all others for seconds.
_RUNTIME = "ZENOH_RUNTIME", "(tx: (worker_threads: 4))"
_SHORTEST_RETRY, _LONGEST_RETRY = 0.5, 5.0  # seconds between two attempts of a client


async def open_session(config: zenoh.Config, *, retry: bool) -> zenoh.Session:
    """Opens a session. With `retry` (a client) it tries one router after another until one answers.

    Raises `GatewayError` when it cannot be opened, a port in use for instance.
    """
    os.environ.setdefault(*_RUNTIME)
    pause = _SHORTEST_RETRY
    while True:
        opening = asyncio.ensure_future(off_loop(zenoh.open, config))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            with suppress(zenoh.ZError):
                await off_loop((await opening).close)  # no caller is left to close it
            raise
        except zenoh.ZError as error:
            if not retry:
                raise GatewayError(
                    f"Zenoh cannot be opened: {_without_place(error)}{_hint(error)}"
                ) from None
            report = log.warning if pause == _SHORTEST_RETRY else log.debug  # a warning once
            report("Zenoh router unreachable", error=_without_place(error))
            _begin_with_next(config)
        await asyncio.sleep(pause)
        pause = min(pause * 2, _LONGEST_RETRY)


def _begin_with_next(config: zenoh.Config) -> None:
    """Moves the first of the endpoints to the end: until its time-out Zenoh's client tries only the
    first one."""
    endpoints = json.loads(config.get_json("connect/endpoints"))
    if isinstance(endpoints, list):
        changed = [*endpoints[1:], *endpoints[:1]]
        config.insert_json5("connect/endpoints", json.dumps(changed))


def _without_place(error: zenoh.ZError) -> str:
    """Returns Zenoh's message without the place in its source."""
    return str(error).partition(" at /")[0]


def _hint(error: zenoh.ZError) -> str:
    in_use = f"os error {errno.EADDRINUSE}" in str(error)
    return ": perhaps this gateway is running already" if in_use else ""
