"""The writers file: clients that may write, known by the signatures of their requests.

A line of the file is `name:secret`. The secret is never sent. A signed request counts once, and
only for seconds: a program that receives it cannot use it again.

The wall clock decides how old a signature is, and may be wrong: it can be set back, or be a day
ahead for a moment. So the nonces of accepted signatures are kept for an hour of the other clock,
which is never set. When one is forgotten, its time becomes a floor: no older signature counts. A
restart keeps a floor on disk. A clock that was ahead for less than the hour locks no writer out.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gateway.contract.access import signatures
from gateway.contract.access.named_secrets import NamedSecrets
from gateway.errors import NotAllowed, Repeated
from gateway.tags.timestamps import rfc3339

LATEST, EARLIEST = 5.0, 1.0  # seconds that a signature may be old, or ahead of our clock
KEPT = 3600.0  # seconds that a nonce is kept
MOST_KEPT = 20_000  # nonces


class _Use(NamedTuple):
    """An accepted signature: when it was `made`, by the wall, and when it arrived."""

    made: float
    at: float


class Writers:
    """The file, reloaded when it changes. Raises `ConfigError` if the first load fails."""

    def __init__(
        self,
        path: Path,
        floor: float = 0.0,
        wall: Callable[[], int] = time.time_ns,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`floor`: of an earlier process, in seconds since 1970. `wall`: ns since 1970."""
        self._wall, self._clock = wall, clock
        self._secrets = NamedSecrets(path, "writers.file")
        self._nonces: dict[str, _Use] = {}  # in the order of acceptance
        self._floor = floor
        self._since = clock() + EARLIEST  # an earlier process may have taken older ones
        self.newest = 0.0  # the time of the newest accepted signature, in seconds since 1970

    def begin(self) -> None:
        """Refuses older signatures from now on: another gateway of the group took them."""
        self._since = max(self._since, self._clock())

    def writer(self, key: str, data: bytes, attachment: bytes | None) -> str:
        """Returns the name of the writer that signed the request. Raises `NotAllowed`,
        `Repeated`."""
        signed = signatures.parse(attachment)
        if signed is None:
            raise NotAllowed(
                'a signature is required, as the attachment {"by", "time", "nonce", "signature"}: '
                "see docs/security.md"
            )
        secret = self._secrets.current().get(signed.by)
        if secret is None or not signed.matches(secret, key, data):
            raise NotAllowed("the signature is wrong: is the secret, the key or the value another?")
        made, now = signed.made, self._clock()
        self._forget(now)
        self._check_time(made, now)
        if signed.nonce in self._nonces:
            raise Repeated("this signed request arrived before: it may have been done")
        self._nonces[signed.nonce] = _Use(made, now)
        self.newest = max(self.newest, made)
        return signed.by

    def _forget(self, now: float) -> None:
        while self._nonces:
            nonce, use = next(iter(self._nonces.items()))
            if now - use.at < KEPT and len(self._nonces) < MOST_KEPT:
                return
            del self._nonces[nonce]
            self._floor = max(self._floor, use.made)

    def _check_time(self, made: float, now: float) -> None:
        age = self._wall() / 1e9 - made
        if age < -EARLIEST:
            raise NotAllowed(f"its time is {-age:.1f} s ahead of the gateway's clock")
        if age >= min(LATEST, now - self._since):
            raise NotAllowed(
                f"it was signed {max(0.0, age):.1f} s ago, more than {LATEST:g} s or before the "
                "gateway began"
            )
        if made <= self._floor:
            until = rfc3339(int(self._floor * 1e9))
            raise NotAllowed(f"the gateway has taken signatures until {until}: is a clock wrong?")
