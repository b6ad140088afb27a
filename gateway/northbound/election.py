"""Two gateways on one line: which of them may speak, decided from signs of life alone.

Each gateway of a group shows a *claim* before it goes on the wire and an *active* sign while it is
there, and sees those of the others a moment later. One that sees no other active sign claims,
keeps looking for `CLAIM` seconds, and only then goes on the wire. Of two claims the one that comes
first by name stays. This holds as long as signs travel in less than half of `CLAIM`; what a
network split does is in docs/standby.md.
"""

from enum import StrEnum
from typing import NamedTuple

# Longer than Zenoh takes to link up again after a connection was cut once (0.5 s), and short
# enough for the line to be served again within 3 s of a crash.
CLAIM = 1.5
# After the network itself went or came back the others may take so long to be seen again.
HOLD = 10.0
# A look that found a sign counts for so long; the sign itself may have gone since.
GLIMPSE = 0.8
# One that was held still for so long may have been taken for dead (the lease is 3 s).
FROZEN = 2.0


class Role(StrEnum):
    """What a gateway shows to the others of its group."""

    CLAIM = "claim"
    ACTIVE = "active"


class Stand(StrEnum):
    WAITING = "waiting"  # passive: ports closed, nothing served
    CLAIMING = "claiming"  # still passive, about to go on the wire
    ACTIVE = "active"
    RELIEVED = "relieved"  # another is active: leave the wire, then start over


class Sign(NamedTuple):
    """A sign of life. Those of equal role are ordered by name, then by session."""

    role: Role
    name: str
    session: str


class Standby:
    """One gateway's view of its group. All times are seconds of one monotonic clock.

    `needs_link`: it is configured to connect to somebody, so without any link it sees nothing
    and does not claim; after `alone` seconds without a link it does all the same.
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
        self.stand = Stand.WAITING
        self.name = name
        self.session = session
        self._needs_link = needs_link
        self._alone = alone
        self._signs: set[Sign] = set()
        self._glimpses: dict[Sign, float] = {}
        self._links: set[str] = set()
        self._routers: set[str] = set()
        self._saw_link = self._saw_router = False
        self._disturbed = self._unlinked = self._claimed = self._looked = now

    def heard(self, sign: Sign, shown: bool) -> None:
        """Another's sign came or went."""
        if sign.session == self.session:
            return
        if shown:
            self._signs.add(sign)
        else:
            self._signs.discard(sign)
            self._glimpses.pop(sign, None)

    def glimpsed(self, sign: Sign, now: float) -> None:
        """Another's sign was found by a look at what is there now."""
        if sign.session != self.session:
            self._glimpses[sign] = now

    def link(self, session: str, up: bool, router: bool, now: float) -> None:
        """A link to a session came or went. `router`: others are seen through it."""
        links = (self._links, self._routers) if router else (self._links,)
        for known in links:
            if up:
                known.add(session)
            else:
                known.discard(session)
        if router or (up and not self._saw_link):
            self._disturbed = now
        self._saw_link |= up
        self._saw_router |= up and router
        if not self._links:
            self._unlinked = now

    def decide(self, now: float) -> Stand:
        """To be called several times a second, and after everything that was heard."""
        paused = now - self._looked > FROZEN
        self._looked = now
        match self.stand:
            case Stand.RELIEVED:
                pass
            case Stand.ACTIVE:
                if paused or self._sees(Role.ACTIVE, now, before_me=True):
                    self.stand = Stand.RELIEVED
            case _ if not self._may_claim(now):
                self.stand = Stand.WAITING
            case _ if self.stand is Stand.WAITING or paused:
                self.stand = Stand.CLAIMING
                self._claimed = now
            case _ if now - self._claimed >= CLAIM:
                self.stand = Stand.ACTIVE
        return self.stand

    @property
    def is_looking(self) -> bool:
        """Whether a look at what is there could change anything: no active one is known."""
        active = any(sign.role is Role.ACTIVE for sign in self._signs)
        return self.stand in (Stand.WAITING, Stand.CLAIMING) and not active

    def others(self) -> list[str]:
        """Names of the others whose active sign is known."""
        return sorted(sign.name for sign in self._signs if sign.role is Role.ACTIVE)

    @property
    def is_blind(self) -> bool:
        """It waits because it cannot see the network."""
        return self.stand is Stand.WAITING and not self._is_linked()

    def _may_claim(self, now: float) -> bool:
        if self._sees(Role.ACTIVE, now) or self._sees(Role.CLAIM, now, before_me=True):
            return False
        if self._is_linked():
            return now - self._disturbed >= HOLD
        return self._alone is not None and now - self._unlinked >= max(self._alone, HOLD)

    def _sees(self, role: Role, now: float, *, before_me: bool = False) -> bool:
        seen = self._signs | {
            sign for sign, when in self._glimpses.items() if now - when <= GLIMPSE
        }
        mine = Sign(role, self.name, self.session)
        return any(sign.role is role and (not before_me or sign < mine) for sign in seen)

    def _is_linked(self) -> bool:
        if self._saw_router:
            return bool(self._routers)
        # Without routers the other gateway's own link is all there is, and goes with it.
        return self._saw_link or not self._needs_link
