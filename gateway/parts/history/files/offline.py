"""A history file without its gateway: read, copied, and brought back after a damage."""

import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from gateway.errors import GatewayError, words_of
from gateway.parts.history.answers.bucket_search import BucketSearch
from gateway.parts.history.answers.outcomes import Ring
from gateway.parts.history.answers.recent import Extent, Recent
from gateway.parts.history.answers.search import Search
from gateway.parts.history.files import aside
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.file import HistoryFile, identity, next_number, runs_of
from gateway.parts.history.store.lock import locked
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.schema import APPLICATION, SCHEMA_VERSION

BUSY_WITHIN = 2.0  # seconds that another program may hold the file; SQLite would try for ever
_RUN = 32_768  # samples
_SIZE = 10**12  # bytes: the gateway drops what is too much
_MOST_BUCKETS = 10_000_000  # of one tag: nobody waits for this reader


@contextmanager
def offline(path: Path) -> Iterator[tuple[Search, BucketSearch]]:
    """Opens the history as it is now. Raises `GatewayError`."""
    if not path.is_file():
        raise GatewayError(f"there is no history {path}")
    reader = Reader(path)
    try:
        recent = _content(path)
        damage = Damage(most_logged=0)  # the answers tell it
        search = Search(recent, reader, damage)
        yield search, BucketSearch(recent, reader, damage, _MOST_BUCKETS)
    except (sqlite3.Error, OSError) as error:
        raise GatewayError(f"{path} cannot be read: {words_of(error)}") from None
    finally:
        reader.renew()


def _content(path: Path) -> Recent:
    """Returns the list of the runs. Samples without a run are runs that are not closed."""
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as database:
        database.execute("BEGIN")  # one state of the file for all statements
        [(application,)] = database.execute("PRAGMA application_id")
        [(version,)] = database.execute("PRAGMA user_version")
        if (application, version) != (APPLICATION, SCHEMA_VERSION):
            raise GatewayError(f"{path} is no history of this version")
        recent = Recent(longest=2**62, oldest=float("inf"))
        recent.opened(identity(database, path), (), lambda *_: Extent(0, 0, 0), 0)
        recent.set_sorted(runs_of(database, next_number(database)))
        return recent


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
        raise GatewayError(f"{history} was not copied to {copy}: {words_of(error)}") from None
    return copy.stat().st_size


def _bounded() -> Callable[[int, int, int], None]:
    until = time.monotonic() + BUSY_WITHIN

    def check(status: int, _left: int, _total: int) -> None:
        if status in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED) and time.monotonic() > until:
            raise sqlite3.OperationalError("another program holds the file")

    return check


def salvage(
    path: Path, report: Callable[[int], None] = lambda _count: None, most_outcomes: int = 100_000
) -> int:
    """Returns how many samples were brought back. Raises `GatewayError`; then nothing has changed.

    `report` gets the number of those of one file meanwhile.

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
            back = sum(_copy(one, file, report, most_outcomes) for one in found)
            if path.exists():
                _copy(path, file, report, most_outcomes)
            file.set_sync(full=True)
            file.empty_log()
        for one in found:
            aside.rename(one, "salvaged")
        if path.exists():
            stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
            aside.move(path, path.with_name(f"{path.name}.replaced-{stamp}"))
        made.rename(path)
    except (OSError, sqlite3.Error) as error:
        raise GatewayError(f"{path} was not salvaged: {words_of(error)}") from None
    finally:
        _remove(made)
        os.close(lock)
    return back


def _copy(
    source: Path, file: HistoryFile, report: Callable[[int], None], most_outcomes: int
) -> int:
    count, begin = 0, file.next_number()
    for batch in aside.rows(source):
        number = file.next_number()
        if number - begin >= _RUN:
            file.close_run(begin, number, time.time_ns())
            begin = number
        file.store_rows(number, batch)
        count += len(batch)
        report(count)
    file.close_run(begin, file.next_number(), time.time_ns())
    for ring in Ring:
        if found := aside.outcomes(source, ring):
            file.store_writes(ring, found, most_outcomes)
    return count


def _remove(path: Path) -> None:
    for tail in ("", "-wal", "-shm", "-journal", ".lock"):
        Path(f"{path}{tail}").unlink(missing_ok=True)
