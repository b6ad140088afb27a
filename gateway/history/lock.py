"""The lock on a history file: one gateway writes it, and only that one."""

import errno
import os
import sys
from pathlib import Path

import structlog

if sys.platform == "win32":
    import msvcrt

    def _take(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _take(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_TAKEN = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)  # the last on Windows


def locked(path: Path) -> int:
    """Takes the lock on a file that need not be there yet; to be closed with `os.close`.

    It is on a file of its own beside the other, which stays there: SQLite would lose its locks
    if anybody else in this process closed the database. The system lets go of it when a process
    ends, in whatever way. Raises `OSError`, of type `BlockingIOError` where it is taken.
    """
    beside = f"{path}.lock"
    try:
        file = _opened(beside)
    except OSError as error:
        said = f"the file cannot be opened ({beside}: {error.strerror})"
        raise OSError(error.errno, said) from None
    try:
        _take(file)
    except OSError as error:
        if error.errno in _TAKEN:
            os.close(file)
            raise BlockingIOError(error.errno, "another gateway writes this file") from None
        log.warning("this disk has no locks: one gateway only may write here", path=str(path))
    return file


def _opened(path: str) -> int:
    """For writing where that is allowed: over NFS there is no lock without."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError:
        return os.open(path, os.O_RDONLY | os.O_CREAT, 0o666)
