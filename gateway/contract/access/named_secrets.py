"""A file with a line `name:secret` for each client, reloaded when it changes."""

import re
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import structlog

from gateway.contract.access.secrets import readable_secret
from gateway.errors import ConfigError

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_MOST = 100  # clients
_LINE = re.compile(r"([\w.\-]{1,60}):([\w.\-~+/=]{20,200})\Z")
_OLD_LINE = re.compile(r"[\w.\-]{1,60}:[\w.\-]{8,100}:[0-9a-fA-F]{64}\Z")
_CHECK_EVERY = 1.0  # seconds between two looks at the file
_WAIT = 0.2  # seconds for a look: the event loop waits for it
HANGS = 10.0  # seconds: a file that does not answer for so long holds no secret


class NamedSecrets:
    """The file. Raises `ConfigError` if the first load fails. If a later one fails, it holds no
    secret."""

    def __init__(self, path: Path, called: str) -> None:
        """`called`: the setting that names the file, such as `writers.file`."""
        self._path = path
        self._called = called
        self._looked = time.monotonic()
        self._look = threading.Thread()
        self._version = self._stat()
        self._secrets = _load(path, called)

    def current(self) -> Mapping[str, bytes]:
        """Returns the secrets by name, those of the file at most a second ago.

        A thread looks at the file: a network file system may hang.
        """
        age = time.monotonic() - self._looked
        if self._look.is_alive():
            if age > HANGS and self._secrets:
                self._reject(f"{self._called} {self._path} does not answer")
        elif age >= _CHECK_EVERY:
            self._looked += age
            self._look = threading.Thread(target=self._reload, name="secrets", daemon=True)
            try:
                self._look.start()
                self._look.join(_WAIT)
            except RuntimeError:  # the system has no thread left
                self._reload()
        return self._secrets

    def _reload(self) -> None:
        version = self._stat()
        if version == self._version:
            return
        try:
            self._secrets = _load(self._path, self._called)
            log.info("secrets reloaded", file=self._called, count=len(self._secrets))
        except ConfigError as error:
            self._reject(str(error))
        self._version = version

    def _reject(self, why: str) -> None:
        self._secrets, self._version = {}, None
        log.error("secrets rejected", why=why, effect="every write is refused")

    def _stat(self) -> tuple[int, ...] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return (found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode)


def _load(path: Path, called: str) -> dict[str, bytes]:
    """Returns the secrets by name."""
    secrets: dict[str, bytes] = {}
    text = readable_secret(path, called)
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        place = f"{called} {path}, line {number}"
        if _OLD_LINE.match(line):
            raise ConfigError(
                f"{place}: tokens are no longer sent, so their hashes are of no use: make a secret "
                "and write the line as name:secret; see docs/security.md"
            )
        match = _LINE.match(line)
        if match is None:
            raise ConfigError(f"{place}: write it as name:secret, with 20 to 200 characters")
        name, secret = match.groups()
        if name in secrets:
            raise ConfigError(f"{place}: {name} is there twice")
        secrets[name] = secret.encode()
    if len(secrets) > _MOST:
        raise ConfigError(f"{called} {path}: {len(secrets)} names, more than {_MOST}")
    return secrets
