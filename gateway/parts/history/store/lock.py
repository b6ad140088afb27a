"""The lock on a history file, so that only one gateway writes it."""

import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path

import structlog

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)


def locked(path: Path) -> int:
    """Takes the lock for a file that may not exist yet. Release it with `os.close`.

    The lock is on a separate file, `<path>.lock`, which is not deleted: closing a second
    descriptor of the database would end SQLite's own locks. The system releases the lock when the
    process ends, however it ends. Raises `OSError`, of type `BlockingIOError` if another process
    has the lock.
    """
    lock_path = Path(f"{path}.lock")
    try:
        file = _opened(lock_path)
    except OSError as error:
        message = f"the file cannot be opened ({lock_path}: {error.strerror})"
        raise OSError(error.errno, message) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(file)
        raise BlockingIOError(error.errno, "another gateway writes this file") from None
    except OSError:
        log.warning(
            "history lock unavailable",
            path=str(path),
            effect="only one gateway may write this file",
        )
    return file


def close_to_others(path: Path) -> None:
    """Creates a file that only owner and group can open, or takes the rights of others away.

    Who can open the lock file can hold the lock. Opens no existing file: closing it would end
    SQLite's locks.
    """
    with suppress(OSError):  # it exists; or who opens it reports the error
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o660))
    with suppress(OSError):  # the file of another user, shared on purpose; or a read-only disk
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & stat.S_IRWXO:
            path.chmod(mode & ~stat.S_IRWXO)


def _opened(path: Path) -> int:
    """Opens for writing where permitted: over NFS a lock needs that."""
    close_to_others(path)
    try:
        return os.open(path, os.O_RDWR)
    except PermissionError:
        return os.open(path, os.O_RDONLY)
