"""The writers file: clients that may write, known by the salted hashes of their tokens.

A line of the file is `name:salt:hash`, where hash is SHA-256 of salt and token in hexadecimal. A
token is long and random, so it needs no slow hash; a slow hash would let any client keep the
gateway busy with wrong tokens.
"""

import hashlib
import hmac
import re
import time
from pathlib import Path
from typing import NamedTuple

import structlog

from gateway.errors import ConfigError, GatewayError
from gateway.northbound.secrets import readable_secret

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

SHORTEST_TOKEN, LONGEST_TOKEN = 20, 200  # characters
_MOST = 100  # writers: each costs a hash for every write
_LINE = re.compile(r"([\w.\-]{1,60}):([\w.\-]{8,100}):([0-9a-fA-F]{64})\Z")
_CHECK_EVERY = 1.0  # seconds between two looks at the file


class NotAllowed(GatewayError):
    """The token is missing or unknown; nothing was done."""


class _Writer(NamedTuple):
    name: str
    salt: bytes
    digest: bytes


class Writers:
    """The file, reloaded when it changes. Raises `ConfigError` if the first load fails."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._checked = time.monotonic()
        self._version = self._stat()
        self._writers = _load(path)

    def owner(self, token: bytes | None) -> str:
        """Returns the name of the token's owner. Raises `NotAllowed`."""
        self._reload()
        if token is None:
            raise NotAllowed("writing needs a token, as the attachment of the query or put")
        if len(token) < SHORTEST_TOKEN:
            raise NotAllowed(f"a token has at least {SHORTEST_TOKEN} characters")
        name = None
        for writer in self._writers:  # always all: the time must not show which one matched
            if hmac.compare_digest(hashlib.sha256(writer.salt + token).digest(), writer.digest):
                name = writer.name
        if name is None:
            raise NotAllowed("the token is unknown")
        return name

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
            self._writers = ()
            log.error("writers file rejected", why=str(error), so="every write is refused")  # noqa: TRY400  (a sentence, no trace)

    def _stat(self) -> tuple[int, ...] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return (found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode)


def _load(path: Path) -> tuple[_Writer, ...]:
    writers: dict[str, _Writer] = {}
    text = readable_secret(path, "writers.file")
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        match = _LINE.match(line)
        if match is None:
            raise ConfigError(f"writers.file {path}, line {number}: write it as name:salt:hash")
        name, salt, digest = match.groups()
        if name in writers:
            raise ConfigError(f"writers.file {path}, line {number}: {name} is there twice")
        writers[name] = _Writer(name, salt.encode(), bytes.fromhex(digest))
    if len(writers) > _MOST:
        raise ConfigError(f"writers.file {path}: {len(writers)} writers, more than {_MOST}")
    return tuple(writers.values())
