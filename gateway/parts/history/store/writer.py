"""The thread that writes the history file, and that survives every failure of the disk.

A failure becomes one sentence for the status, and the thread tries the file again every second.
"""

import sqlite3
import threading
import time
from pathlib import Path

import structlog

from gateway.errors import Damaged, words_of
from gateway.parts.history.files.aside import asides
from gateway.parts.history.store.file import HistoryFile, is_damage, move_aside
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.schema import ForeignFile
from gateway.parts.history.store.transfer import Transfer

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

COMMIT_EVERY = 0.05  # seconds
SYNC_EVERY = 1.0  # seconds of samples that a power cut may cost
RETRY_EVERY = 1.0  # seconds
MOST_MOVED_ASIDE = 3  # damaged files since the start; after that the disk is the cause
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
    """Opens the file, keeps it in order and closes it. The public fields are for the status."""

    def __init__(self, path: Path, max_size: int, transfer: Transfer, reader: Reader) -> None:
        self.trouble: str | None = "not opened yet"
        self.aside: list[Path] = []  # files that were moved aside, and that no person knows yet
        self.readable = False  # the file was opened once, so the list of sorted runs is complete
        self._path = path
        self._max_size = max_size
        self._transfer = transfer
        self._reader = reader
        self._file: HistoryFile | None = None
        self._moved_aside = 0
        self._next_sync = 0.0
        self._next_try = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)

    # -- any thread --

    def start(self) -> None:
        self._thread.start()

    def close(self, within: float) -> bool:
        """Stores everything in memory and ends; True if that took less than `within` seconds."""
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
            if not ended:  # an unexpected exception: Python prints its trace
                self._failed("history has failed: start the gateway again")

    def _write(self) -> None:
        ending = False
        while not ending:
            started = time.monotonic()
            ending = self._closing.is_set()
            if started >= self._next_try or ending:
                self._try()
            self._closing.wait(max(0.0, started + COMMIT_EVERY - time.monotonic()))
        self._close_file()
        if self._transfer.is_unfinished:
            log.error("history samples lost", samples=self._transfer.waiting)

    def _try(self) -> None:
        try:
            if self._file is None:
                self._file = HistoryFile(self._path, self._max_size)
                self._transfer.opened(self._file)
                self._reader.renew()
                self.readable = True
            self._store(self._file)
        except (ForeignFile, Damaged, UnicodeDecodeError) as error:  # SQLite quotes damaged text
            self._damaged(str(error))
        except sqlite3.Error as error:
            if is_damage(error):
                self._damaged(str(error))
            else:
                self._failed(_sentence(error))
        except OSError as error:
            self._failed(words_of(error))

    def _store(self, file: HistoryFile) -> None:
        now = time.monotonic()
        if now >= self._next_sync:
            self._next_sync = now + SYNC_EVERY
            self.aside = asides(self._path)
            if not file.is_in_place():
                file.empty_log()  # otherwise SQLite would write it into the file now at this path
                raise FileNotFoundError(0, "the file was taken away")
            file.set_sync(full=True)
        self._transfer.run(file)
        file.set_sync(full=False)
        if self.trouble is not None:
            log.info("history ready", path=str(self._path))
            self.trouble = None

    # -- trouble --

    def _damaged(self, why: str) -> None:
        self._close_file()
        if self._moved_aside >= MOST_MOVED_ASIDE:
            self._failed("the file was damaged again and again: the disk is not to be trusted")
            return
        self._moved_aside += 1
        try:
            move_aside(self._path, why)
        except OSError as error:
            self._failed(f"the file is damaged and cannot be moved: {error.strerror}")
            return
        self._next_try = 0.0

    def _failed(self, sentence: str) -> None:
        if self.trouble != sentence:
            log.error("history failed", path=str(self._path), why=sentence)
        self.trouble = sentence
        self._next_try = time.monotonic() + RETRY_EVERY
        self._close_file()

    def _close_file(self) -> None:
        """SQLite recovers from most failures only when the file is closed and opened again."""
        file, self._file = self._file, None
        self._reader.renew()
        if file is None:
            return
        try:
            file.close()
        except sqlite3.Error as error:
            log.warning("history file close failed", error=str(error))


def _sentence(error: sqlite3.Error) -> str:
    name = getattr(error, "sqlite_errorname", "")
    plain = next((text for start, text in _SENTENCES.items() if name.startswith(start)), None)
    return str(error) if plain is None else f"{plain} ({error})"
