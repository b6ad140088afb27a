"""Who may write, where Zenoh cannot say it: tokens, known only by their salted hashes.

A line of the file is `name:salt:hash`, where hash is SHA-256 of salt and token in hexadecimal. A
token is made by a machine and long, so no slow hash is needed to guard it; a slow one would let
anybody keep the gateway busy with wrong tokens.
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
_LOOK_EVERY = 1.0  # seconds until the file is looked at again


class NotAllowed(GatewayError):
    """The token is missing, or nobody's; nothing was done."""


class Asker(NamedTuple):
    """What is known of who asks."""

    session: str | None = None  # Zenoh's id, where it is told
    token: bytes | None = None


class _Writer(NamedTuple):
    name: str
    salt: bytes
    digest: bytes


class Writers:
    """The file, read again when it has changed. Raises `ConfigError` when made with a bad one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._looked = time.monotonic()
        self._version = self._stat()
        self._known = _read(path)

    def owner(self, token: bytes | None) -> str:
        """The name of whoever holds the token. Raises `NotAllowed`."""
        self._renew()
        if token is None:
            raise NotAllowed("writing needs a token, as the attachment of the query or put")
        if len(token) < SHORTEST_TOKEN:
            raise NotAllowed(f"a token has at least {SHORTEST_TOKEN} characters")
        name = None
        for writer in self._known:  # all of them, so that time tells nothing
            if hmac.compare_digest(hashlib.sha256(writer.salt + token).digest(), writer.digest):
                name = writer.name
        if name is None:
            raise NotAllowed("nobody has this token")
        return name

    def _renew(self) -> None:
        now = time.monotonic()
        if now - self._looked < _LOOK_EVERY:
            return
        self._looked = now
        version = self._stat()
        if version == self._version:
            return
        self._version = version
        try:
            self._known = _read(self._path)
            log.info("writers read again", count=len(self._known))
        except ConfigError as error:
            self._known = ()
            log.error("nobody may write until this is mended", why=str(error))  # noqa: TRY400  (a sentence, no trace)

    def _stat(self) -> tuple[int, ...] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return (found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode)


def _read(path: Path) -> tuple[_Writer, ...]:
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
