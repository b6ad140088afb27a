"""The thread that reads the history file slowly: damage is known before a query meets it."""

import sqlite3
import threading

from gateway.errors import Busy
from gateway.parts.history.search import Search

READ_EVERY = 1.0  # seconds between two reads of about 2,000 samples: a few ms of work each
AGAIN_AFTER = 3600.0  # seconds between two passes


class Checker:
    """`Search` notes the damage."""

    def __init__(self, search: Search) -> None:
        self._search = search
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="history check", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Lets the thread end after its present read."""
        self._closing.set()

    def _run(self) -> None:
        pause = READ_EVERY
        while not self._closing.wait(pause):
            pause = READ_EVERY  # until there is a run to read
            try:
                for _ in self._search.check():
                    pause = AGAIN_AFTER
                    if self._closing.wait(READ_EVERY):
                        return
            except (sqlite3.Error, OSError, Busy):
                pause = READ_EVERY  # the writing thread reports that the file cannot be read
