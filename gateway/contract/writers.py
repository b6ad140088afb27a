"""The writers file: clients that may write, known by the signatures of their requests.

A line of the file is `name:secret`. The secret is never sent. A signed request counts once, and
only for seconds: a program that receives it cannot use it again.
"""

import time
from collections.abc import Callable
from pathlib import Path

from gateway.contract import signatures
from gateway.contract.named_secrets import NamedSecrets
from gateway.errors import GatewayError

LATEST, EARLIEST = 5.0, 1.0  # seconds that a signature may be old, or ahead of our clock


class NotAllowed(GatewayError):
    """The signature is missing, wrong or too old; nothing was done."""


class Repeated(GatewayError):
    """A signed request arrived twice. The first one may have been done."""


class Writers:
    """The file, reloaded when it changes. Raises `ConfigError` if the first load fails."""

    def __init__(self, path: Path, wall: Callable[[], int] = time.time_ns) -> None:
        """`wall`: ns since 1970."""
        self._wall = wall
        self._secrets = NamedSecrets(path, "writers.file")
        self._nonces: dict[str, float] = {}  # with the times of their signatures
        self._since = wall() / 1e9 + EARLIEST  # an earlier process may have taken older ones

    def begin(self) -> None:
        """Refuses older signatures from now on: another gateway of the group took them."""
        self._since = max(self._since, self._wall() / 1e9)

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
        self._check_time(signed.made)
        if signed.nonce in self._nonces:
            raise Repeated("this signed request arrived before: it may have been done")
        self._nonces[signed.nonce] = signed.made
        return signed.by

    def _check_time(self, made: float) -> None:
        now = self._wall() / 1e9
        self._since = max(self._since, now - LATEST)
        for nonce in [nonce for nonce, at in self._nonces.items() if at <= self._since]:
            del self._nonces[nonce]
        if made > now + EARLIEST:
            raise NotAllowed(f"its time is {made - now:.1f} s ahead of the gateway's clock")
        if made <= self._since:
            age = max(0.0, now - made)
            raise NotAllowed(
                f"it was signed {age:.1f} s ago, more than {LATEST:g} s or before the gateway began"
            )
