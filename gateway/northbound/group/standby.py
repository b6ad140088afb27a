"""Hot standby on Zenoh: declares and observes the liveliness tokens that `election` decides by."""

import asyncio
import hmac
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import structlog
import zenoh

from gateway.contract.documents.state import StandbyDocument
from gateway.contract.keys import Keys
from gateway.contract.rate_limit import RateLimit
from gateway.line.send_permit import SendPermit
from gateway.northbound.group.election import Election, Role, RoleToken, State
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.northbound.requests.inbox import Inbox
from gateway.northbound.session.session import SecondSession
from gateway.plant.threads import off_loop

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_DECIDE_EVERY = 0.2  # seconds
_QUERY_TIMEOUT = 0.4  # seconds
_DECISIONS_WITHOUT_LINK = 15  # until the missing link is logged
_TOKENS = {
    State.STANDBY: (Role.WAITING,),
    State.CLAIMING: (Role.CLAIM,),
    State.ACTIVE: (Role.CLAIM, Role.ACTIVE),
}


@dataclass(frozen=True, slots=True)
class GroupSettings:
    """Settings that the gateways of a plant share. `alone`: seconds, see `Election`.

    `group`: the standby group, None for a gateway outside of any. `secret_file`: its first line is
    the secret that signs tokens and claims.
    """

    group: str | None = None
    alone: float | None = None
    secret_file: Path | None = None


class Standby:
    """Sets `active` when this gateway may open its lines, `replaced` when it must close them.

    Without a group it is `enabled` false, and active at once and for ever.
    """

    def __init__(
        self, settings: GroupSettings, secret: PlantSecret | None, keys: Keys, duty: SendPermit
    ) -> None:
        """`duty` gets the proof that this gateway is active, again and again."""
        self.enabled = settings.group is not None
        self.active = asyncio.Event()
        self.replaced = asyncio.Event()
        self._name = settings.group or ""
        self._alone = settings.alone
        if not self.enabled:
            self.active.set()
        self._keys = keys
        self._group = GroupTokens(keys, self._name, secret)
        self._duty = duty
        self._election: Election | None = None
        self._session: zenoh.Session | None = None  # of the tokens
        self._tokens: dict[Role, zenoh.LivelinessToken] = {}
        self._declared: list[object] = []  # Zenoh undeclares an object without a reference

    def documents(self) -> dict[str, StandbyDocument]:
        """The status document; none without a standby group."""
        if not self.enabled:
            return {}
        election = self._election
        return {
            "standby": {
                "group": self._name,
                "stand": (State.STANDBY if election is None else election.state).value,
                "others_active": [] if election is None else election.others(Role.ACTIVE),
                "others_waiting": [] if election is None else election.others(Role.WAITING),
            }
        }

    async def run(self, session: zenoh.Session, second: SecondSession) -> None:
        """Runs until cancelled. `session` is the gateway's own; the tokens are in `second`. Raises
        `GatewayError`, `ZError`."""
        if not self.enabled:
            return
        election = self._election = Election(
            self._keys.gateway,
            str(session.zid()),
            time.monotonic(),
            needs_link=second.needed,
            alone=self._alone,
        )
        opening = asyncio.create_task(self._open(second, election))
        try:
            await self._decide(election, opening)
        finally:
            opening.cancel()
            with suppress(asyncio.CancelledError):
                await opening

    async def _open(self, second: SecondSession, election: Election) -> None:
        """Observes the group as soon as the session of the tokens is open."""
        found = await second.session()

        def token_changed(sample: zenoh.Sample, _at: float) -> None:
            if token := self._group.parse(str(sample.key_expr), time.monotonic()):
                election.token_changed(token, sample.kind == zenoh.SampleKind.PUT)

        def link_changed(event: zenoh.TransportEvent, _at: float) -> None:
            linked, kind = str(event.transport.zid), str(event.transport.whatami)
            is_up = event.kind != zenoh.SampleKind.DELETE
            election.link_changed(linked, is_up, kind == "router", time.monotonic())

        tokens = zenoh.handlers.Callback(Inbox(token_changed, lambda _: None), indirect=False)
        links = zenoh.handlers.Callback(Inbox(link_changed, lambda _: None), indirect=False)
        self._session = found

        def declare() -> list[object]:
            return [
                found.info.declare_transport_events_listener(links, history=True),
                found.liveliness().declare_subscriber(self._group.all, tokens, history=True),
            ]

        self._declared = await off_loop(declare)

    async def _decide(self, election: Election, opening: asyncio.Task[None]) -> None:
        def token_found(reply: zenoh.Reply, _at: float) -> None:
            now = time.monotonic()
            if reply.ok and (token := self._group.parse(str(reply.ok.key_expr), now)):
                election.token_found(token, now)

        replies = Inbox(token_found, lambda _: None)
        without_link = 0
        while True:
            if opening.done():
                opening.result()
            before, state = election.state, election.decide(time.monotonic())
            if state is not before:
                log.info("standby state changed", group=self._name, state=state.value)
            await self._update_tokens(election, state)
            if state is State.ACTIVE:
                self._duty.prove(asyncio.get_running_loop().time())
                self.active.set()
            if state is State.REPLACED and not self.replaced.is_set():
                by = election.replaced_by
                log.error(
                    "gateway replaced",
                    why="another gateway of the group may be active",
                    token=None if by is None else self._group.key(by),
                )
                self.replaced.set()
            without_link = without_link + 1 if election.waits_for_link else 0
            if without_link == _DECISIONS_WITHOUT_LINK:
                log.warning("standby link missing", effect="the gateway waits for the network")
            if election.needs_query and self._session is not None:
                await off_loop(self._query_tokens, self._session, replies)
            await asyncio.sleep(_DECIDE_EVERY)

    async def _update_tokens(self, election: Election, state: State) -> None:
        """Declares and undeclares tokens until they are those of the state."""
        session = self._session
        if session is None or state is State.REPLACED:
            return  # replaced: the token stays until the lines are really closed
        wanted = _TOKENS.get(state, ())
        for role in wanted:
            if role not in self._tokens:
                key = self._group.key(RoleToken(role, self._keys.gateway, election.session))
                self._tokens[role] = await off_loop(session.liveliness().declare_token, key)
        for role in [role for role in self._tokens if role not in wanted]:
            await off_loop(self._tokens.pop(role).undeclare)

    def _query_tokens(self, session: zenoh.Session, replies: Inbox[zenoh.Reply]) -> None:
        """Queries the tokens besides subscribing to them, so that one lost message does no
        harm."""
        handler = zenoh.handlers.Callback(replies, indirect=False)
        session.liveliness().get(self._group.all, handler, timeout=_QUERY_TIMEOUT)


_SHOWN = 300  # characters of a refused key


class GroupTokens:
    """Makes keys, and parses those of other gateways."""

    def __init__(self, keys: Keys, group: str, secret: PlantSecret | None) -> None:
        """Without a `secret` tokens are not signed, and every token of the group counts."""
        self._keys = keys
        self._stem = keys.group(group)
        self._secret = secret
        self._log_limit = RateLimit(10, 60.0)  # any client can declare as many as it likes

    @property
    def all(self) -> str:
        return f"{self._stem}/**"

    def key(self, token: RoleToken) -> str:
        key = f"{self._stem}/{token.role.value}/{token.name}/{token.session}"
        return key if self._secret is None else f"{key}/{self._secret.signature(key)}"

    def parse(self, key: str, now: float) -> RoleToken | None:
        """Returns None, and logs the key, for a token that this group did not sign."""
        match key.removeprefix(f"{self._stem}/").split("/"):
            case [role, name, session, *signature] if role in list(Role):
                token = RoleToken(Role(role), name, session)
                if self._secret is None and len(signature) <= 1:
                    return token
                if self._secret and hmac.compare_digest(key.encode(), self.key(token).encode()):
                    return token
        if self._log_limit.allows(now):
            log.error(
                "standby token refused",
                token=key[:_SHOWN],
                why="it is not signed with the secret of this gateway",
            )
        return None
