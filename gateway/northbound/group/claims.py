"""The rules by which gateways under one prefix share out the devices.

Each gateway claims its devices before it opens a line. A ticket orders the claims: it is the time,
but always later than every ticket that its gateway saw. When two claims name one device, the
device belongs to the earlier ticket, or to the smaller session id of equal tickets. So a gateway
that comes second never displaces the first, whatever the clocks say, and two gateways that see
both claims decide alike. No ticket is later than `LAST_TICKET`. The other gateway *withholds* the
device: no polls, values or writes.

The members of a standby group have the same devices. Their election decides, not the claims. Of
two gateways with one name only the first serves, whatever their devices are.

Synchronous; does no I/O. `now` is in seconds of one monotonic clock.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

# A device that no other gateway claims any more is claimed again after this time, so that a
# gateway that restarts gets its devices back.
RETURN_TIME = 10.0
LAST_TICKET = 2**62  # the year 2116; every JSON library knows such an integer
MOST_OTHERS = 1000  # claims of others that are known at once


class Claim(NamedTuple):
    """The devices of one gateway. Claims are ordered by ticket, then by session."""

    ticket: int
    session: str
    name: str  # of the gateway
    group: str | None  # of its standby group
    devices: frozenset[str]


class Claims:
    """One gateway's view of all claims, and its own."""

    def __init__(self, session: str, name: str, group: str | None, devices: Iterable[str]) -> None:
        """`devices`: all of the file."""
        self.own: Claim | None = None
        self._devices = frozenset(devices)
        self._session, self._name, self._group = session, name, group
        self._others: dict[str, Claim] = {}  # by session
        self._free_since: float | None = None

    def change(self, devices: Iterable[str], withheld: Iterable[str]) -> None:
        """Has other devices from now on. The own claim keeps its place before later ones."""
        self._devices = frozenset(devices)
        if self.own is not None:
            self.own = self.own._replace(devices=self._devices.difference(withheld))

    def found(self, claim: Claim) -> None:
        """Another gateway claims, or our own claim was seen."""
        known = claim.session in self._others or len(self._others) < MOST_OTHERS
        if claim.session != self._session and known:
            self._others[claim.session] = claim

    def lost(self, session: str) -> None:
        """A claim has ended."""
        self._others.pop(session, None)

    def claim(self, now: int, withheld: Iterable[str]) -> Claim:
        """Makes the own claim. `now` in ns since 1970."""
        latest = max([now, *(other.ticket + 1 for other in self._others.values())])
        ticket = min(latest, LAST_TICKET)
        devices = self._devices.difference(withheld)
        self.own = Claim(ticket, self._session, self._name, self._group, devices)
        return self.own

    def taken(self, devices: Iterable[str] | None = None) -> dict[str, str]:
        """Returns the devices of the file, or of another one, that belong to other gateways, with
        their names."""
        own = self.own
        wanted = self._devices if devices is None else frozenset(devices)
        return {
            device: other.name
            for other in sorted(self._others.values(), reverse=True)  # the first one stays
            if self._group is None or other.group != self._group
            for device in wanted & other.devices
            if own is None or device not in own.devices or other < own
        }

    def namesake(self) -> bool:
        """True if an earlier gateway has the same name: their keys would be the same."""
        return any(
            other.name == self._name and (self.own is None or other < self.own)
            for other in self._others.values()
        )

    def changed(self, withheld: Mapping[str, str], now: float) -> bool:
        """True when the withheld devices must become those of `taken`. Call it regularly."""
        taken = self.taken().keys()
        if not taken <= withheld.keys():
            return True
        if taken == withheld.keys():
            self._free_since = None
        elif self._free_since is None:
            self._free_since = now
        return self._free_since is not None and now - self._free_since >= RETURN_TIME
