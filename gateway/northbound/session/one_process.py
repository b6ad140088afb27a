"""Notices a second process of the same gateway, also without any network."""

import fcntl
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog

from gateway.errors import GatewayError

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)


@contextmanager
def only_process(folder: Path | None, gateway: str, *endpoints: str) -> Iterator[None]:
    """Holds a lock file of the gateway. Raises `GatewayError` if another process does.

    `folder`: of the files that the gateway writes; None: no lock. `gateway`: its own key.
    `endpoints`: a machine may have separate networks. The system frees the lock when the process
    ends, however it ends. Only owner and root can open the file, and so hold the lock. The event
    loop opens it: no line runs yet.
    """
    name = hashlib.sha256("\n".join((gateway, *endpoints)).encode()).hexdigest()[:16]
    held = None if folder is None else _locked(folder / f"gateway-{name}.lock", gateway)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)


def _locked(path: Path, gateway: str) -> int | None:
    """Returns None where no lock is possible: claims on the network remain."""
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        file = os.open(path, flags, 0o600)
    except OSError as error:
        log.debug("gateway lock unavailable", path=str(path), why=str(error))
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise GatewayError(
            f"{gateway} runs already on this machine: a second process would poll and write twice"
        ) from None
    except OSError as error:
        log.debug("gateway lock unavailable", path=str(path), why=str(error))
    return file
