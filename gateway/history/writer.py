"""The thread that writes the history file: stores, sorts, drops the oldest, and outlives trouble.

Whatever the disk does ends here: it becomes one sentence for the status, and the file is tried
again every second until it works.
"""

import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path

import structlog

from gateway.history.file import Foreign, HistoryFile, is_damage, move_aside
from gateway.history.outcomes import Outcomes
from gateway.history.reader import Reader
from gateway.history.recent import Recent, Run, Shelved

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

COMMIT_EVERY = 0.05  # seconds
SYNC_EVERY = 1.0  # seconds of samples that a power cut may cost
RETRY_EVERY = 1.0  # seconds
MOST_AT_ONCE = 8192  # samples in one transaction
MOST_ASIDE = 3  # damaged files moved away since the start; then the disk is to blame
ROOM_OF_A_WRITE = 1024  # bytes on disk, at most a tenth of the file are writes
_SENTENCES = {
    "SQLITE_FULL": "the disk is full",
    "SQLITE_READONLY": "the file or its disk can only be read",
    "SQLITE_CANTOPEN": "the file cannot be opened",
    "SQLITE_IOERR": "the disk fails, or allows no more",
    "SQLITE_BUSY": "another program holds the file",
    "SQLITE_LOCKED": "another program holds the file",
    "SQLITE_CORRUPT": "the file is damaged",
    "SQLITE_NOTADB": "the file is damaged",
}


class Writer:
    """Owns the file. The public fields are for the status."""

    def __init__(
        self,
        path: Path,
        keep: float,
        max_size: int,
        recent: Recent,
        outcomes: Outcomes,
        reader: Reader,
        wall: Callable[[], int],
    ) -> None:
        self.trouble: str | None = "not opened yet"
        self.readable = False  # the file was opened once, so that the shelf is complete
        self.size = 0
        self.stored = 0
        self._path = path
        self._keep = int(keep * 1e9)
        self._max_size = max_size
        self._recent = recent
        self._outcomes = outcomes
        self._reader = reader
        self._wall = wall
        self._file: HistoryFile | None = None
        self._aside = 0
        self._begun: list[Run] = []  # runs with a number, not yet sorted
        self._may_expire = 2  # runs, for their age
        self._next_expiry = 0.0
        self._next_sync = 0.0
        self._next_try = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)

    # -- any thread --

    def start(self) -> None:
        self._thread.start()

    def close(self, within: float) -> bool:
        """Stores what waits and ends; whether that was done within so many seconds."""
        if self._thread.ident is None:  # never started
            return True
        self._closing.set()
        self._thread.join(max(0.0, within))
        return not self._thread.is_alive()

    # -- the history thread --

    def _run(self) -> None:
        ended = False
        try:
            self._write()
            ended = True
        finally:
            if not ended:  # nobody has foreseen that, and Python prints where it was
                self._failed("history has failed: start the gateway again")

    def _write(self) -> None:
        ending = False
        while not ending:
            started = time.monotonic()
            ending = self._closing.is_set()
            if started >= self._next_try or ending:
                self._try()
            self._closing.wait(max(0.0, started + COMMIT_EVERY - time.monotonic()))
        self._let_go()
        if (waiting := self._recent.waiting) or self._outcomes:
            log.error("history ends with samples that no disk took", samples=waiting)

    def _try(self) -> None:
        try:
            if self._file is None:
                self._file = HistoryFile(self._path, self._max_size)
                self._take_stock(self._file)
            self._turn(self._file)
        except Foreign as error:
            self._damaged(str(error))
        except sqlite3.Error as error:
            if is_damage(error):
                self._damaged(str(error))
            else:
                self._failed(_sentence(error))
        except OSError as error:
            self._failed(error.strerror or str(error))

    def _take_stock(self, file: HistoryFile) -> None:
        """What of the samples in memory is in the file, which may be another one now."""
        unsorted = file.unsorted()
        self._recent.opened(file.identity, file.shelved(), unsorted)
        self._outcomes.opened(file.identity, file.last_write())
        self._begun = [run for run in self._recent.runs() if run.number]
        begun = {run.number for run in self._begun}
        for number in unsorted:
            if number not in begun:  # left by an earlier life, or dropped from memory
                file.sort(number, self._wall())
        self._recent.reshelve(file.shelved())
        self._reader.renew()
        self.readable = True

    def _turn(self, file: HistoryFile) -> None:
        """All there is to do now."""
        now = time.monotonic()
        if now >= self._next_sync:
            self._next_sync = now + SYNC_EVERY
            if not file.is_there():
                file.empty_log()  # or SQLite would put it into whatever took the file's place
                raise FileNotFoundError(0, "the file was taken away")
            file.sync(full=True)
        self._store_writes(file)
        self._recent.close_old()
        for run in self._recent.runs():
            self._store(file, run)
            self._sort(file)
            self._make_room(file)
        file.sync(full=False)
        if self.trouble is not None:
            log.info("history is written", path=str(self._path))
            self.trouble = None

    def _store(self, file: HistoryFile, run: Run) -> None:
        while (count := len(run.samples)) > run.stored:
            if not run.number:
                run.number = file.new_run()
                self._begun.append(run)
            upto = min(count, run.stored + MOST_AT_ONCE)
            file.store(run.number, run.stored, run.samples[run.stored : upto])
            self.stored += upto - run.stored
            self._recent.stored(run, upto)

    def _store_writes(self, file: HistoryFile) -> None:
        if not self._outcomes:
            return
        most = max(100, self._max_size // 10 // ROOM_OF_A_WRITE)
        begun = self._outcomes.begin(file.last_write())
        try:
            last = file.store_writes(begun, most)
        except sqlite3.Error:
            self._outcomes.undone()
            raise
        self._outcomes.done(last)

    def _sort(self, file: HistoryFile) -> None:
        for run in list(self._begun):
            if run.dropped or (run.closed and run.stored == len(run.samples)):
                self._recent.sorted_on_disk(run, file.sort(run.number, self._wall()))
                self._begun.remove(run)
                self._may_expire = 2

    def _make_room(self, file: HistoryFile) -> None:
        """Drops at most one run, so that nothing new waits for long."""
        if file.log_size() > file.log_limit:
            file.empty_log()
            if file.log_size() > max(file.log_limit, self._max_size // 4):
                raise BlockingIOError(0, "another program reads the file and does not end")
        now = time.monotonic()
        if now >= self._next_expiry:
            self._next_expiry = now + min(10.0, self._keep / 1e9 / 20)
            self._may_expire = 2
            file.shrink()
        self.size = file.size()
        if self.size > self._max_size:
            file.shrink()
        shelf = self._recent.shelf
        if shelf and file.used() > self._max_size - 3 * file.log_limit:
            self._drop(file, shelf[0])
        elif self._may_expire:
            # Never many at once: the clock may be wrong for a while.
            self._may_expire -= 1
            before = self._wall() - self._keep
            file.drop_writes(before)
            old = (run for run in shelf if max(run.last, run.closed) < before)
            if (expired := next(old, None)) is not None:
                self._drop(file, expired)

    def _drop(self, file: HistoryFile, dropped: Shelved) -> None:
        self._recent.reshelve(run for run in self._recent.shelf if run is not dropped)
        file.drop(dropped.number)

    # -- trouble --

    def _damaged(self, why: str) -> None:
        self._let_go()
        if self._aside >= MOST_ASIDE:
            self._failed("the file was damaged again and again: the disk is not to be trusted")
            return
        self._aside += 1
        try:
            move_aside(self._path, why)
        except OSError as error:
            self._failed(f"the file is damaged and cannot be moved: {error.strerror}")
            return
        self._next_try = 0.0

    def _failed(self, sentence: str) -> None:
        if self.trouble != sentence:
            log.error("history cannot be written", path=str(self._path), why=sentence)
        self.trouble = sentence
        self._next_try = time.monotonic() + RETRY_EVERY
        self._let_go()

    def _let_go(self) -> None:
        """Closing is what SQLite needs to find its feet again."""
        file, self._file = self._file, None
        self._reader.renew()
        if file is None:
            return
        try:
            file.close()
        except sqlite3.Error as error:
            log.warning("the history file did not close well", error=str(error))


def _sentence(error: sqlite3.Error) -> str:
    name = getattr(error, "sqlite_errorname", "")
    plain = next((said for start, said in _SENTENCES.items() if name.startswith(start)), None)
    return str(error) if plain is None else f"{plain} ({error})"
