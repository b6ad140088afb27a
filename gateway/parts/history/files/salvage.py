"""Brings the samples of files that were moved aside back into the history of a stopped gateway."""

import os
import sqlite3
import time
from contextlib import closing
from pathlib import Path

from gateway.errors import GatewayError
from gateway.parts.history.answers.outcomes import Ring
from gateway.parts.history.files import aside
from gateway.parts.history.store.file import HistoryFile
from gateway.parts.history.store.lock import locked

_RUN = 32_768  # samples
_SIZE = 10**12  # bytes: the gateway drops what is too much


def salvage(path: Path, most_outcomes: int = 100_000) -> int:
    """Returns how many samples were brought back. Raises `GatewayError`; then nothing has changed.

    The new file has the samples of all files that were moved aside, and then those of the present
    history. The old files get another name.
    """
    found = aside.asides(path)
    if not found:
        raise GatewayError(f"no file beside {path} was moved aside")
    made = path.with_name(f"{path.name}.salvaging")
    try:
        lock = locked(path)
    except OSError as error:
        raise GatewayError(f"stop the gateway first: {error.strerror}") from None
    try:
        _remove(made)
        with closing(HistoryFile(made, _SIZE)) as file:
            file.set_sync(full=False)
            back = sum(_copy(one, file, most_outcomes) for one in found)
            if path.exists():
                _copy(path, file, most_outcomes)
            file.set_sync(full=True)
            file.empty_log()
        for one in found:
            aside.rename(one, "salvaged")
        if path.exists():
            stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
            aside.move(path, path.with_name(f"{path.name}.replaced-{stamp}"))
        made.rename(path)
    except (OSError, sqlite3.Error) as error:
        raise GatewayError(f"{path} was not salvaged: {error}") from None
    finally:
        _remove(made)
        os.close(lock)
    return back


def _copy(source: Path, file: HistoryFile, most_outcomes: int) -> int:
    count, begin = 0, file.next_number()
    for batch in aside.rows(source):
        number = file.next_number()
        if number - begin >= _RUN:
            file.close_run(begin, number, time.time_ns())
            begin = number
        file.store_rows(number, batch)
        count += len(batch)
    file.close_run(begin, file.next_number(), time.time_ns())
    for ring in Ring:
        if found := aside.outcomes(source, ring):
            file.store_writes(ring, found, most_outcomes)
    return count


def _remove(path: Path) -> None:
    for tail in ("", "-wal", "-shm", "-journal", ".lock"):
        Path(f"{path}{tail}").unlink(missing_ok=True)
