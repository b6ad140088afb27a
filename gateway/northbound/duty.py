"""Hot standby on Zenoh: shows and sees the signs that `gateway.standby` decides by."""

import asyncio
import time
from dataclasses import dataclass

import structlog
import zenoh

from gateway.keys import Keys
from gateway.northbound.inbox import Inbox
from gateway.northbound.links import Links
from gateway.northbound.session import off_loop
from gateway.standby import Role, Sign, Stand, Standby

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_LOOK_EVERY = 0.2  # seconds
_LOOK_FOR = 400  # ms


@dataclass(frozen=True, slots=True)
class StandbySettings:
    """`group` is shared by the gateways of one plant. `alone`: seconds, see `Standby`."""

    group: str
    alone: float | None = None


class Duty:
    """`on` is set when this gateway may go on the wire, `relieved` when it must leave it."""

    def __init__(
        self,
        settings: StandbySettings | None,
        keys: Keys,
        links: Links,
        *,
        needs_link: bool,
        routed: bool,
    ) -> None:
        """Without settings on duty at once, and for ever. `routed`: a client, which sees others
        only through whatever it is linked to."""
        self.stands_by = settings is not None
        self.on = asyncio.Event()
        self.relieved = asyncio.Event()
        self._settings = settings or StandbySettings("")
        if not self.stands_by:
            self.on.set()
        self._keys = keys
        self._links = links
        self._needs_link = needs_link
        self._routed = routed
        self._standby: Standby | None = None
        self._tokens: dict[Role, zenoh.LivelinessToken] = {}

    def documents(self) -> dict[str, dict[str, object]]:
        """For the status; nothing where nobody stands by."""
        if not self.stands_by:
            return {}
        stand = Stand.WAITING if self._standby is None else self._standby.stand
        others = [] if self._standby is None else self._standby.others()
        shown: dict[str, object] = {
            "group": self._settings.group,
            "stand": stand.value,
            "others_active": others,
        }
        return {"standby": shown}

    async def run(self, session: zenoh.Session) -> None:
        """Until cancelled. The links are declared after this was begun. Raises `ZError`."""
        if not self.stands_by:
            return
        own = str(session.zid())
        standby = self._standby = Standby(
            self._keys.gateway,
            own,
            time.monotonic(),
            needs_link=self._needs_link,
            alone=self._settings.alone,
        )
        self._links.listener = self._link
        under = f"{self._keys.group(self._settings.group)}/**"
        heard = Inbox(self._hear, lambda _: None)
        found = Inbox(self._find, lambda _: None)
        live = session.liveliness()

        def subscribe() -> object:
            events = zenoh.handlers.Callback(heard, indirect=False)
            return live.declare_subscriber(under, events, history=True)

        def look() -> None:
            # Beside the subscription: what is there is then found in two ways.
            answers = zenoh.handlers.Callback(found, indirect=False)
            live.get(under, answers, timeout=_LOOK_FOR / 1000)

        subscriber = await off_loop(subscribe)  # kept: what is forgotten is undeclared
        told = None
        while subscriber is not None:
            before, stand = standby.stand, standby.decide(time.monotonic())
            if stand is not before:
                await self._change(session, own, before, stand)
            if told is not (blind := standby.is_blind) and not self.on.is_set():
                told = blind
                if blind:
                    log.warning("standby: no link, so nobody can be seen: waiting for the network")
            if standby.is_looking:
                await off_loop(look)
            await asyncio.sleep(_LOOK_EVERY)

    async def _change(self, session: zenoh.Session, own: str, before: Stand, stand: Stand) -> None:
        log.info("standby", group=self._settings.group, stand=stand.value)
        match stand:
            case Stand.CLAIMING:
                await self._show(session, Role.CLAIM, own)
            case Stand.WAITING:
                await self._withdraw(Role.CLAIM)
            case Stand.ACTIVE:
                await self._show(session, Role.ACTIVE, own)
                self.on.set()
            case Stand.RELIEVED:
                log.error("another gateway of the group is active: this one leaves the wire")
                self.relieved.set()

    async def _show(self, session: zenoh.Session, role: Role, own: str) -> None:
        key = self._keys.sign(self._settings.group, role.value, self._keys.gateway, own)
        self._tokens[role] = await off_loop(session.liveliness().declare_token, key)

    async def _withdraw(self, role: Role) -> None:
        if token := self._tokens.pop(role, None):
            await off_loop(token.undeclare)

    def _hear(self, sample: zenoh.Sample) -> None:
        if (sign := _sign(str(sample.key_expr))) and self._standby:
            self._standby.heard(sign, sample.kind == zenoh.SampleKind.PUT)

    def _find(self, reply: zenoh.Reply) -> None:
        sign = None if reply.ok is None else _sign(str(reply.ok.key_expr))
        if sign is not None and self._standby:
            self._standby.glimpsed(sign, time.monotonic())

    def _link(self, there: str, what: str, came: bool) -> None:
        if self._standby:
            router = self._routed or what == "router"
            self._standby.link(there, came, router, time.monotonic())


def _sign(key: str) -> Sign | None:
    """`…/@standby/<group>/<role>/<name>/<session>`"""
    *_, role, name, session = key.split("/")
    return Sign(Role(role), name, session) if role in list(Role) else None
