"""The rules of a standby group: which of its gateways may open the lines.

Each gateway declares a liveliness token in the role *claim* before it becomes active, and one in
the role *active* while it is; the others see these tokens a moment later. A gateway that sees no
other active token claims, waits for `CLAIM_TIME`, and only then becomes active. If two claim, the
first by name continues. This holds as long as a token travels in less than half of `CLAIM_TIME`;
docs/standby.md explains a split network. A standby gateway has a token in the role *waiting*.

Synchronous; does no I/O. All times are seconds of one monotonic clock.
"""

from enum import StrEnum
from typing import NamedTuple

# Longer than Zenoh takes to link up again after a connection was cut once (0.5 s), and short
# enough that another gateway is active within 3 s of a crash.
CLAIM_TIME = 1.5
# After the network itself was lost or restored, other tokens may arrive this much later.
SETTLE_TIME = 10.0
# A token found by a query counts for this long; it may have been undeclared since.
QUERY_VALIDITY = 0.8
# After a longer pause of its process, a gateway may have lost its tokens (the lease is 3 s).
LONGEST_PAUSE = 2.0
MOST_TOKENS = 1000  # of others; without a secret any client can declare as many as it likes


class Role(StrEnum):
    """The roles of liveliness tokens."""

    CLAIM = "claim"
    ACTIVE = "active"
    WAITING = "waiting"  # decides nothing: the others see that a gateway could replace them


class State(StrEnum):
    """The states of a gateway; the values stand in its status document."""

    STANDBY = "waiting"  # ports closed, the plant not served
    CLAIMING = "claiming"  # still passive, about to become active
    ACTIVE = "active"
    REPLACED = "relieved"  # another gateway is active: close the ports, then start over


class RoleToken(NamedTuple):
    """A liveliness token. Tokens of one role are ordered by name, then by session."""

    role: Role
    name: str
    session: str


class _Links:
    """The links of a gateway. Without them it sees no other gateway."""

    def __init__(self, now: float, *, needed: bool) -> None:
        self.changed = now  # the network itself was lost or restored
        self.lost = now  # no link since
        self._needed = needed
        # The active gateway was last seen through a link of its own: a router does not matter.
        self._is_direct = False
        self._all: set[str] = set()
        self._routers: set[str] = set()
        self._had_link = self._had_router = False

    def update(self, session: str, up: bool, router: bool, now: float) -> None:
        for linked in (self._all, self._routers) if router else (self._all,):
            if up:
                linked.add(session)
            else:
                linked.discard(session)
        if router or (up and not self._had_link):
            self.changed = now
        self._had_link |= up
        self._had_router |= up and router
        if not self._all:
            self.lost = now

    def saw(self, session: str) -> None:
        """The active gateway is seen now, with this session."""
        self._is_direct = session in self._all

    def are_settled(self, now: float) -> bool:
        return self._is_direct or now - self.changed >= SETTLE_TIME

    @property
    def are_up(self) -> bool:
        if self._had_router and not self._is_direct:
            return bool(self._routers)
        # Without routers the other gateway's link may be the only one, and ends with it.
        return self._had_link or not self._needed


class Election:
    """One gateway's view of its group, and its own state in it.

    `needs_link`: the gateway connects to other sessions, so without a link it sees nothing and
    does not claim. `alone`: after this many seconds without a link it claims nevertheless.
    """

    def __init__(
        self,
        name: str,
        session: str,
        now: float,
        *,
        needs_link: bool,
        alone: float | None = None,
    ) -> None:
        self.state = State.STANDBY
        self.name = name
        self.session = session
        self._alone = alone
        self._tokens: set[RoleToken] = set()
        self._found: dict[RoleToken, float] = {}  # by queries, with the time
        self._links = _Links(now, needed=needs_link)
        self._claimed = self._decided = now
        self.replaced_by: RoleToken | None = None  # None: held for too long

    def token_changed(self, token: RoleToken, present: bool) -> None:
        """Another gateway has declared or undeclared a token."""
        if token.session == self.session:
            return
        if present and len(self._tokens) < MOST_TOKENS:
            self._tokens.add(token)
        elif not present:
            self._tokens.discard(token)
            self._found.pop(token, None)

    def token_found(self, token: RoleToken, now: float) -> None:
        """A query has found a token of another gateway."""
        if token.session != self.session and len(self._found) < MOST_TOKENS:
            self._found[token] = now

    def link_changed(self, session: str, up: bool, router: bool, now: float) -> None:
        """A link is up or down. `router`: other gateways are seen through it."""
        self._links.update(session, up, router, now)

    def decide(self, now: float) -> State:
        """Updates the state. Call it several times a second, and after every change."""
        paused = now - self._decided > LONGEST_PAUSE
        self._decided = now
        self._found = {t: at for t, at in self._found.items() if now - at <= QUERY_VALIDITY}
        for token in self._tokens:
            if token.role is Role.ACTIVE:
                self._links.saw(token.session)
        match self.state:
            case State.REPLACED:
                pass
            case State.ACTIVE:
                self.replaced_by = self._seen(Role.ACTIVE, before_me=True)
                if paused or self.replaced_by is not None:
                    self.state = State.REPLACED
            case _ if not self._may_claim(now):
                self.state = State.STANDBY
            case _ if self.state is State.STANDBY or paused:
                self.state = State.CLAIMING
                self._claimed = now
            case _ if now - self._claimed >= CLAIM_TIME:
                self.state = State.ACTIVE
        return self.state

    @property
    def needs_query(self) -> bool:
        """True while a query for tokens could change the state: no active gateway is known."""
        active = any(token.role is Role.ACTIVE for token in self._tokens)
        return self.state in (State.STANDBY, State.CLAIMING) and not active

    @property
    def waits_for_link(self) -> bool:
        return self.state is State.STANDBY and not self._links.are_up

    def others(self, role: Role) -> list[str]:
        """Names of the other gateways with a token of this role."""
        return sorted(token.name for token in self._tokens if token.role is role)

    def _may_claim(self, now: float) -> bool:
        if self._seen(Role.ACTIVE) or self._seen(Role.CLAIM, before_me=True):
            return False
        if self._links.are_up:
            return self._links.are_settled(now)
        return self._alone is not None and now - self._links.lost >= max(self._alone, SETTLE_TIME)

    def _seen(self, role: Role, *, before_me: bool = False) -> RoleToken | None:
        seen = self._tokens | self._found.keys()
        mine = RoleToken(role, self.name, self.session)
        found = (token for token in seen if token.role is role and (not before_me or token < mine))
        return min(found, default=None)
