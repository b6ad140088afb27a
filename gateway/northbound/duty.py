"""Hot standby on Zenoh: shows and sees the signs that `gateway.standby` decides by.

A router does not pass on what one peer says to another, and gateways are peers. So a gateway that
connects to somebody sends and sees its signs in a session of its own, as a client.
"""

import asyncio
import json
import time
from contextlib import suppress
from dataclasses import dataclass

import structlog
import zenoh

from gateway.northbound.election import Role, Sign, Stand, Standby
from gateway.northbound.inbox import Inbox
from gateway.northbound.keys import Keys
from gateway.northbound.session import as_client, off_loop, opened

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_LOOK_EVERY = 0.2  # seconds
_LOOK_FOR = 400  # ms
_TOLD_AFTER = 15  # looks without a link
_SHOWN = {Stand.CLAIMING: (Role.CLAIM,), Stand.ACTIVE: (Role.CLAIM, Role.ACTIVE)}


@dataclass(frozen=True, slots=True)
class StandbySettings:
    """`group` is shared by the gateways of one plant. `alone`: seconds, see `Standby`."""

    group: str
    alone: float | None = None


class Duty:
    """`on` is set when this gateway may go on the wire, `relieved` when it must leave it.

    Without settings it is on duty at once and for ever.
    """

    def __init__(self, settings: StandbySettings | None, keys: Keys, config: zenoh.Config) -> None:
        """`config`: of the gateway's own session."""
        self.stands_by = settings is not None
        self.on = asyncio.Event()
        self.relieved = asyncio.Event()
        self._settings = settings or StandbySettings("")
        if not self.stands_by:
            self.on.set()
        self._keys = keys
        connects = json.loads(config.get_json("connect/endpoints")) not in ([], {}, None)
        self._config = as_client(config) if connects and self.stands_by else None
        self._standby: Standby | None = None
        self._seen_through: zenoh.Session | None = None
        self._tokens: dict[Role, zenoh.LivelinessToken] = {}
        self._kept: list[object] = []

    def documents(self) -> dict[str, dict[str, object]]:
        """For the status; nothing where nobody stands by."""
        if not self.stands_by:
            return {}
        stand = Stand.WAITING if self._standby is None else self._standby.stand
        others = [] if self._standby is None else self._standby.others()
        group = self._settings.group
        return {"standby": {"group": group, "stand": stand.value, "others_active": others}}

    async def run(self, session: zenoh.Session) -> None:
        """Until cancelled. `session` is the gateway's own. Raises `GatewayError`, `ZError`."""
        if not self.stands_by:
            return
        self._standby = Standby(
            self._keys.gateway,
            str(session.zid()),
            time.monotonic(),
            needs_link=self._config is not None,
            alone=self._settings.alone,
        )
        opening = asyncio.create_task(self._open(session))
        try:
            await self._decide(self._standby, opening)
        finally:
            opening.cancel()
            with suppress(asyncio.CancelledError):
                await opening
            own = self._seen_through
            if own is not None and own is not session:
                await off_loop(own.close)

    async def _open(self, session: zenoh.Session) -> None:
        """The session the signs travel in, once there is somebody to connect to."""
        found = session if self._config is None else await opened(self._config, retry=True)
        heard = Inbox(self._hear, lambda _: None)
        links = Inbox(self._link, lambda _: None)
        self._seen_through = found

        def declare() -> list[object]:
            signs = zenoh.handlers.Callback(heard, indirect=False)
            events = zenoh.handlers.Callback(links, indirect=False)
            return [
                found.info.declare_transport_events_listener(events, history=True),
                found.liveliness().declare_subscriber(self._under, signs, history=True),
            ]

        self._kept = await off_loop(declare)  # what is forgotten is undeclared

    async def _decide(self, standby: Standby, opening: asyncio.Task[None]) -> None:
        found = Inbox(self._find, lambda _: None)
        blind = 0
        while True:
            if opening.done():
                opening.result()
            before, stand = standby.stand, standby.decide(time.monotonic())
            if stand is not before:
                log.info("standby", group=self._settings.group, stand=stand.value)
            await self._show(stand)
            if stand is Stand.ACTIVE:
                self.on.set()
            if stand is Stand.RELIEVED and not self.relieved.is_set():
                log.error("this gateway leaves the wire: another of its group may be on it")
                self.relieved.set()
            blind = blind + 1 if standby.is_blind else 0
            if blind == _TOLD_AFTER:
                log.warning("standby: no link, so nobody can be seen: waiting for the network")
            if standby.is_looking and self._seen_through is not None:
                await off_loop(self._look, self._seen_through, found)
            await asyncio.sleep(_LOOK_EVERY)

    async def _show(self, stand: Stand) -> None:
        """Shows and takes back tokens until they are those of the stand."""
        session = self._seen_through
        if session is None or stand is Stand.RELIEVED:
            return  # relieved: the sign stays until the wire is really left
        wanted = _SHOWN.get(stand, ())
        for role in [role for role in self._tokens if role not in wanted]:
            await off_loop(self._tokens.pop(role).undeclare)
        for role in wanted:
            if role not in self._tokens:
                life = "" if self._standby is None else self._standby.session
                group, name = self._settings.group, self._keys.gateway
                key = self._keys.sign(group, role.value, name, life)
                self._tokens[role] = await off_loop(session.liveliness().declare_token, key)

    @property
    def _under(self) -> str:
        return f"{self._keys.group(self._settings.group)}/**"

    def _look(self, session: zenoh.Session, found: Inbox[zenoh.Reply]) -> None:
        """Beside the subscription: what is there is found in two ways."""
        answers = zenoh.handlers.Callback(found, indirect=False)
        session.liveliness().get(self._under, answers, timeout=_LOOK_FOR / 1000)

    def _hear(self, sample: zenoh.Sample) -> None:
        if (sign := _sign(str(sample.key_expr))) and self._standby:
            self._standby.heard(sign, sample.kind == zenoh.SampleKind.PUT)

    def _find(self, reply: zenoh.Reply) -> None:
        sign = None if reply.ok is None else _sign(str(reply.ok.key_expr))
        if sign is not None and self._standby:
            self._standby.glimpsed(sign, time.monotonic())

    def _link(self, event: zenoh.TransportEvent) -> None:
        if self._standby:
            there, what = str(event.transport.zid), str(event.transport.whatami)
            came = event.kind != zenoh.SampleKind.DELETE
            self._standby.link(there, came, what == "router", time.monotonic())


def _sign(key: str) -> Sign | None:
    """`…/@standby/<group>/<role>/<name>/<session>`"""
    *_, role, name, session = key.split("/")
    return Sign(Role(role), name, session) if role in list(Role) else None
