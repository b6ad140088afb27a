"""A small file that is replaced as a whole, by a thread: a stalled disk delays nothing else."""

import threading
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

import orjson
import structlog

from gateway import files
from gateway.errors import words_of

log = structlog.get_logger("gateway")
T = TypeVar("T")
ASIDE = ".bad"  # end of the name of a damaged file


class SavedFile:
    """One file, and the thread that writes it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._saved: bytes | None = None
        self.trouble: str | None = None  # why the last snapshot is not saved
        self._saving = threading.Lock()
        self._queue: SimpleQueue[bytes | None] = SimpleQueue()  # None ends the thread
        self._thread = threading.Thread(target=self._save_all, name="state", daemon=True)

    # -- any thread --

    def start(self) -> None:
        """Starts the thread that saves."""
        self._thread.start()

    def save_soon(self, snapshot: bytes) -> bool:
        """Never waits. False while another snapshot waits: then this one is ignored."""
        if not self._queue.empty():
            return False
        self._queue.put(snapshot)
        return True

    def save_last(self, snapshot: bytes) -> None:
        """Never waits: `close` waits for this snapshot."""
        self._queue.put(snapshot)
        self._queue.put(None)

    def close(self, within: float) -> bool:
        """Blocks for at most `within` seconds; True if the thread has ended."""
        if self._thread.ident is None:  # never started
            return True
        self._thread.join(max(0.0, within))
        return not self._thread.is_alive()

    def _save_all(self) -> None:
        while (snapshot := self._queue.get()) is not None:
            self.save(snapshot)

    def save(self, snapshot: bytes) -> None:
        """Replaces the file, completely or not at all: it is on disk if there is no `trouble`.

        Blocks. Logs each kind of trouble once.
        """
        with self._saving:
            self._save(snapshot)

    def _save(self, snapshot: bytes) -> None:
        if snapshot == self._saved and self._path.exists():
            self.trouble = None
            return
        try:
            files.put(self._path, snapshot)  # names of operators are in it: closed to others
        except OSError as error:
            if self.trouble != (why := words_of(error)):
                self.trouble = why
                log.warning("state file not saved", file=str(self._path), why=why)
            return
        self._saved, self.trouble = snapshot, None

    # -- loading --

    def load(
        self, parse: Callable[[Any], T], decode: Callable[[bytes], object] = orjson.loads
    ) -> T | None:
        """Returns the parsed content; None without a file. Moves a file aside that `decode` or
        `parse` refuse by ValueError, TypeError, KeyError or AttributeError."""
        try:
            data = files.read(self._path)
        except FileNotFoundError:
            return None
        except OSError as error:
            log.warning("state file not read", file=str(self._path), why=words_of(error))
            return None
        try:
            return parse(decode(data))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self._move_aside(repr(error))
            return None

    def _move_aside(self, why: str) -> None:
        aside = self._path.with_name(self._path.name + ASIDE)
        try:
            self._path.replace(aside)
        except OSError as error:
            log.warning(
                "state file damaged", file=str(self._path), why=why, not_moved=words_of(error)
            )
        else:
            log.warning("state file damaged", file=str(self._path), why=why, moved_to=str(aside))
