"""Admission to the OPC UA server: certificates, users, and a bounded number of places."""

import hmac
import logging
import time
from collections.abc import Container
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TypeVar

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole

from gateway.bridges.opcua.trust import Refused, TrustList
from gateway.bridges.program import say
from gateway.contract.access.named_secrets import NamedSecrets
from gateway.contract.rate_limit import RateLimit

MOST_CONNECTIONS, MOST_OF_HOST = 1_100, 50
MOST_SESSIONS, MOST_OF_USER = 1_000, 25
MOST_SUBSCRIPTIONS, MOST_OF_SESSION = 2_000, 20
MOST_ITEMS, MOST_ITEMS_OF_SESSION = 200_000, 100_000
MOST_OPERATIONS = 2_500  # nodes in one request
MOST_MESSAGE = 2 * 2**20  # bytes of a request
MOST_CHUNK = 65_535
QUEUE, EVENT_QUEUE = 100, 1_000  # samples of one monitored item
AGAIN, MOST_RECENT = 60.0, 100  # seconds until a sentence is said again; sentences
HELD = 10.0  # seconds: what arrived before such a pause of this process is too old
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # goes on in a suspended machine
_T = TypeVar("_T")


@dataclass(slots=True)
class Admission:
    """`trust`: None without security. `users`: None without `--users`. `writers`: the names of the
    users that may write."""

    trust: TrustList | None
    users: NamedSecrets | None
    writers: Container[str]
    anonymous: bool
    plain: bool  # the security policy None
    _beat: float = field(default_factory=lambda: time.clock_gettime(_CLOCK))
    _said: RateLimit = field(default_factory=lambda: RateLimit(30, 10.0))
    _recent: dict[str, float] = field(default_factory=dict)  # when each sentence was said

    def get_user(
        self,
        _server: object,
        username: str | None = None,
        password: str | None = None,
        certificate: object = None,
    ) -> User | None:
        """Called by asyncua when a session is activated. None: refused."""
        if username is None:
            return User(UserRole.User) if self.anonymous else None
        given = (password or "").encode()
        found = None
        for name, secret in (self.users.current() if self.users else {}).items():
            if hmac.compare_digest(given, secret) and name == username:
                found = User(UserRole.User, name)
        if found is None:
            self.refused(f"the user {username[:60]!r}", "its name or its token is wrong")
        return found

    def is_known(self, user: User) -> bool:
        """Returns False for a user that was withdrawn since."""
        if user.name is None:
            return self.anonymous
        return self.users is not None and user.name in self.users.current()

    def may_write(self, user: User) -> bool:
        return user.name is not None and user.name in self.writers

    def secret_of(self, user: User) -> str | None:
        """Returns `name:secret`, with which the writes of a user are signed."""
        secret = self.users.current().get(user.name or "") if self.users else None
        return None if secret is None else f"{user.name}:{secret.decode()}"

    def check(self, certificate: bytes | None, peer: str) -> None:
        """Raises `Refused` for a client whose certificate is not accepted."""
        if self.trust is None:
            raise Refused(ua.StatusCodes.BadSecurityPolicyRejected, "the server has no certificate")
        try:
            self.trust.check(certificate, datetime.now(UTC))
        except Refused as refusal:
            why = str(refusal)
            if refusal.code == ua.StatusCodes.BadSecurityChecksFailed and certificate:
                file = self.trust.reject(certificate)
                why += f": to trust it, move {file} to trusted/" if file else ""
            self.refused(f"a client at {peer}", why)
            raise

    def refused(self, who: str, why: str) -> None:
        """Says it, but not as often as clients try."""
        now, sentence = time.monotonic(), f"{who} was refused: {why}"
        if now - self._recent.get(sentence, -AGAIN) < AGAIN or not self._said.allows(now):
            return
        self._recent.pop(sentence, None)
        self._recent[sentence] = now
        if len(self._recent) > MOST_RECENT:
            del self._recent[next(iter(self._recent))]
        more = self._said.newly_suppressed()
        say(sentence + (f" ({more} others before)" if more else ""))

    def beat(self) -> bool:
        """Called every second or so. Returns True if this process was held before."""
        was_held, self._beat = self.is_held(), time.clock_gettime(_CLOCK)
        return was_held

    def is_held(self) -> bool:
        """True if requests may have waited: the process was stopped, or the machine slept."""
        return time.clock_gettime(_CLOCK) - self._beat > HELD


def limited(params: _T, called: str, most: int = MOST_OPERATIONS) -> _T:
    """Returns the parameters of a service. Raises `ServiceError` for none or too many nodes."""
    found = getattr(params, called)
    if not found:
        raise ServiceError(ua.StatusCodes.BadNothingToDo)
    if len(found) > most:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)
    return params


def revise(asked: ua.MonitoringParameters, most: int, all_by_default: bool) -> None:
    """asyncua takes 0 for as many as it allows; OPC UA says one, but of events all."""
    least = most if all_by_default and asked.QueueSize <= 1 else 1
    asked.QueueSize = min(max(asked.QueueSize, least), most)
    if isinstance(asked.Filter, ua.ExtensionObject) and asked.Filter.TypeId.is_null():
        asked.Filter = None  # as it looks on the wire


class Quiet(logging.Handler):
    """Takes the log of asyncua: a garbled request is a page there, and a client can send many."""

    def __init__(self, admission: Admission) -> None:
        super().__init__(logging.ERROR)
        self._admission = admission

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and (error := record.exc_info[1]):
            self._admission.refused("a request", f"{record.getMessage()}: {error!r}"[:300])
