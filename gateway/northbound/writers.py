"""The writers file: clients that may write, known by the signatures of their requests.

A line of the file is `name:secret`. The secret is never sent. A signed request counts once, and
only for seconds: a program that receives it cannot use it again.
"""

import re
import time
from collections.abc import Callable
from pathlib import Path

import structlog

from gateway.errors import ConfigError, GatewayError
from gateway.northbound import signatures
from gateway.northbound.secrets import readable_secret

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

LATEST, EARLIEST = 5.0, 1.0  # seconds that a signature may be old, or ahead of our clock
_MOST = 100  # writers
_LINE = re.compile(r"([\w.\-]{1,60}):([\w.\-~+/=]{20,200})\Z")
_OLD_LINE = re.compile(r"[\w.\-]{1,60}:[\w.\-]{8,100}:[0-9a-fA-F]{64}\Z")
_CHECK_EVERY = 1.0  # seconds between two looks at the file


class NotAllowed(GatewayError):
    """The signature is missing, wrong or too old; nothing was done."""


class Repeated(GatewayError):
    """A signed request arrived twice. The first one may have been done."""


class Writers:
    """The file, reloaded when it changes. Raises `ConfigError` if the first load fails."""

    def __init__(self, path: Path, wall: Callable[[], int] = time.time_ns) -> None:
        """`wall`: ns since 1970."""
        self._path = path
        self._wall = wall
        self._checked = time.monotonic()
        self._version = self._stat()
        self._writers = _load(path)
        self._nonces: dict[str, float] = {}  # with the times of their signatures
        self._since = wall() / 1e9 + EARLIEST  # an earlier process may have taken older ones

    def begin(self) -> None:
        """Refuses older signatures from now on: another gateway of the group took them."""
        self._since = max(self._since, self._wall() / 1e9)

    def writer(self, key: str, data: bytes, attachment: bytes | None) -> str:
        """Returns the name of the writer that signed the request. Raises `NotAllowed`,
        `Repeated`."""
        self._reload()
        signed = signatures.parse(attachment)
        if signed is None:
            raise NotAllowed(
                'a signature is required, as the attachment {"by", "time", "nonce", "signature"}: '
                "see docs/security.md"
            )
        secret = self._writers.get(signed.by)
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

    def _reload(self) -> None:
        now = time.monotonic()
        if now - self._checked < _CHECK_EVERY:
            return
        self._checked = now
        version = self._stat()
        if version == self._version:
            return
        self._version = version
        try:
            self._writers = _load(self._path)
            log.info("writers file reloaded", count=len(self._writers))
        except ConfigError as error:
            self._writers = {}
            log.error("writers file rejected", why=str(error), so="every write is refused")  # noqa: TRY400  (a sentence, no trace)

    def _stat(self) -> tuple[int, ...] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return (found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode)


def _load(path: Path) -> dict[str, bytes]:
    """Returns the secrets by name."""
    writers: dict[str, bytes] = {}
    text = readable_secret(path, "writers.file")
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        place = f"writers.file {path}, line {number}"
        if _OLD_LINE.match(line):
            raise ConfigError(
                f"{place}: tokens are no longer sent, so their hashes are of no use: make a secret "
                "and write the line as name:secret; see docs/security.md"
            )
        match = _LINE.match(line)
        if match is None:
            raise ConfigError(f"{place}: write it as name:secret, with 20 to 200 characters")
        name, secret = match.groups()
        if name in writers:
            raise ConfigError(f"{place}: {name} is there twice")
        writers[name] = secret.encode()
    if len(writers) > _MOST:
        raise ConfigError(f"writers.file {path}: {len(writers)} writers, more than {_MOST}")
    return writers
