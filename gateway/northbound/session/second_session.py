"""The session that sees other gateways.

A router does not pass on messages between two peers, and gateways are peers. So a gateway that
connects to other sessions sees other gateways only in a second session, as a client.
"""

import asyncio
import json
from contextlib import suppress

import zenoh

from gateway.northbound.session.session import open_session
from gateway.northbound.session.session_settings import as_client
from gateway.plant.threads import off_loop

_CLOSE_WITHIN = 0.3  # seconds; a router that hangs must not delay the end


class SecondSession:
    """Opens the second session, or uses the gateway's own where that sees all."""

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
