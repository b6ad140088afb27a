"""The sessions of Zenoh: opened and closed without blocking the event loop."""

import asyncio
import errno
import json
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import structlog
import zenoh

from gateway.contract.access import secrets
from gateway.errors import ConfigError, GatewayError
from gateway.northbound.session.session_settings import as_client, endpoints, reachable
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
            if retry:  # a mute router takes seconds, and a client holds no port meanwhile
                opening.add_done_callback(_close_unwanted)
                raise
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
        await asyncio.sleep(pause)
        pause = min(pause * 2, _LONGEST_RETRY)


def _close_unwanted(opening: asyncio.Future[zenoh.Session]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        threading.Thread(target=opening.result().close, daemon=True).start()


def _without_place(error: zenoh.ZError) -> str:
    """Returns Zenoh's message without the place in its source."""
    return str(error).partition(" at /")[0]


def _hint(error: zenoh.ZError) -> str:
    in_use = f"os error {errno.EADDRINUSE}" in str(error)
    return ": perhaps this gateway is running already" if in_use else ""


_CLOSE_WITHIN = 0.3  # seconds; a router that hangs must not delay the end


class SecondSession:
    """The session that sees other gateways; the gateway's own where that sees all.

    A router does not pass on messages between two peers, and gateways are peers. So a gateway that
    connects to other sessions sees other gateways only in a second session, as a client.
    """

    def __init__(self, config: zenoh.Config) -> None:
        """`config`: of the gateway's own session."""
        connects = json.loads(config.get_json("connect/endpoints")) not in ([], {}, None)
        self._config = as_client(config) if connects else None
        self._opened = asyncio.Event()
        self._session: zenoh.Session | None = None

    @property
    def needed(self) -> bool:
        return self._config is not None

    @property
    def opened(self) -> list[zenoh.Session]:
        """The session, if it is open."""
        return [] if self._session is None else [self._session]

    async def session(self) -> zenoh.Session:
        """Waits until the session is open: without a network this takes until there is one."""
        while (session := self._session) is None:
            await self._opened.wait()
        return session

    async def run(self, own: zenoh.Session) -> None:
        """Opens it, and closes it when cancelled. `own`: the gateway's own. Raises
        `GatewayError`."""
        opened = self._session = (
            own if self._config is None else await open_session(self._config, retry=True)
        )
        self._opened.set()
        try:
            await asyncio.Event().wait()
        finally:
            if opened is not own:
                with suppress(zenoh.ZError, TimeoutError):
                    async with asyncio.timeout(_CLOSE_WITHIN):
                        await off_loop(opened.close)


_TLS = "transport/link/tls"
_PASSWORDS = "transport/auth/usrpwd"


async def forget_dead_routes(config: zenoh.Config) -> None:
    """Lets Zenoh forget a router that has died: links a session to that of `config` for a moment.

    A peer of Zenoh 1.10 keeps the route of a key that was asked through a router. When that router
    has died, each query of the key gets all its replies, and then a time-out instead of the end,
    for ever. Any session that links to the peer makes it find its routes again. Without a place
    for clients to connect to there is nothing to do.
    """
    if endpoints(config, "listen"):
        await off_loop(_visit, config)


def _visit(config: zenoh.Config) -> None:
    try:
        zenoh.open(visitor(config)).close()  # type: ignore[no-untyped-call]  # the stub lacks it
    except (zenoh.ZError, ConfigError) as error:
        log.warning("dead router kept", why=str(error), effect="queries of its keys end late")


def visitor(config: zenoh.Config) -> zenoh.Config:
    """Returns the configuration of a session that links to that of `config`. Reads the users."""
    copy = zenoh.Config.from_json5(str(config))
    here = [reachable(endpoint) for endpoint in endpoints(config, "listen")[:1]]
    settings = {
        "listen/endpoints": [],
        "connect/endpoints": here,
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "access_control/enabled": False,
    }
    for side in ("certificate", "private_key"):
        settings[f"{_TLS}/connect_{side}"] = json.loads(config.get_json(f"{_TLS}/listen_{side}"))
    users = json.loads(config.get_json(f"{_PASSWORDS}/dictionary_file"))
    if users is not None:
        user, password = next(iter(secrets.users(Path(users)).items()))
        settings |= {f"{_PASSWORDS}/user": user, f"{_PASSWORDS}/password": password}
        settings[f"{_PASSWORDS}/dictionary_file"] = None
    for path, value in settings.items():
        copy.insert_json5(path, json.dumps(value))
    return copy
