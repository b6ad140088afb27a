"""A copy of a history file, also while a gateway writes it."""

import os
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from gateway.errors import GatewayError

BUSY_WITHIN = 2.0  # seconds that another program may hold the file; SQLite would try for ever


def backup(history: Path, copy: Path) -> int:
    """Copies the history completely or not at all; returns the bytes of the copy.

    It is the state of one moment. SQLite copies all pages in one step: the writer goes on, and a
    copy in several steps would begin again at each of its commits. Raises `GatewayError`.
    """
    if not history.is_file():
        raise GatewayError(f"there is no history {history}")
    if copy.exists():
        raise GatewayError(f"{copy} exists: name a new file")
    unfinished = copy.with_name(f"{copy.name}.unfinished")
    try:
        os.close(os.open(unfinished, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))
        with (
            closing(sqlite3.connect(history, timeout=BUSY_WITHIN)) as source,
            closing(sqlite3.connect(unfinished)) as target,  # it waits for the disk by itself
        ):
            source.backup(target, progress=_bounded())
        unfinished.rename(copy)
    except (OSError, sqlite3.Error) as error:
        with suppress(OSError):
            unfinished.unlink()
        raise GatewayError(f"{history} was not copied to {copy}: {error}") from None
    return copy.stat().st_size


def _bounded() -> Callable[[int, int, int], None]:
    until = time.monotonic() + BUSY_WITHIN

    def check(status: int, _left: int, _total: int) -> None:
        if status in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED) and time.monotonic() > until:
            raise sqlite3.OperationalError("another program holds the file")

    return check
