"""Notices changed files: their content is another one, and they stood still for a second."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from gateway import files as disk

STILL = 1.0  # seconds
LOOK_EVERY = 0.5  # seconds

_State = tuple[int, int, int]  # of a file: when it was written, size, number


class Watch:
    """The content of some files when they were read last. Every call reads the disk."""

    def __init__(self) -> None:
        self._read: Mapping[Path, bytes] = {}
        self._seen: Mapping[Path, _State | None] = {}
        self._since: float | None = None  # when the last change was seen; None: it is dealt with

    def note(self, files: Iterable[Path]) -> None:
        """Notes the content that is about to be read."""
        files = [*files]
        self._seen = {file: _state(file) for file in files}
        self._read = {file: _digest(file) for file in files}
        self._since = None

    def changed(self, files: Iterable[Path], now: float) -> bool:
        """Returns True once for a change. `now`: in seconds of a steady clock."""
        seen = {file: _state(file) for file in files}
        if seen != self._seen:
            self._seen, self._since = seen, now
        if self._since is None or now - self._since < STILL:
            return False
        self._since = None
        read = {file: _digest(file) for file in seen}
        before, self._read = self._read, read
        return read != before


def _state(file: Path) -> _State | None:
    """Follows links: some replace a folder of files by another one."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def _digest(file: Path) -> bytes:
    try:
        return hashlib.sha256(disk.read(file)).digest()
    except OSError:
        return b""
