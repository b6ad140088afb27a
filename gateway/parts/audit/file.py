"""The files of the audit: one that grows, and older ones. Everything here blocks."""

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from gateway import files
from gateway.parts.audit.chain import Event, Link, lines, link

MOST = 10 * 2**20  # bytes of a file
OLDER = 9  # files; the oldest is deleted for a new one
_LONGEST = 2**20  # bytes of a record


class AuditFile:
    """Appends records. Raises `OSError`; then no record of the call was written."""

    def __init__(self, path: Path, most: int = MOST) -> None:
        self.last = Link()
        self._path = path
        self._most = most
        self._opened = False

    def append(self, events: Sequence[Event]) -> None:
        """Writes the records to the disk, and returns when they are there."""
        if not self._opened:
            self._open()
        data, last = lines(self.last, events)
        if (size := self._size()) and size + len(data) > self._most:
            self._rotate()
        number = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            files.append(number, data, sync=True)
        finally:
            os.close(number)
        self.last = last

    def _open(self) -> None:
        """Finds the last record. A line that was not written to its end was never told."""
        for path in (self._path, _older(self._path, 1)):
            with suppress(FileNotFoundError), path.open("r+b") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(max(0, size - _LONGEST))
                tail = file.read()
                whole = tail[: tail.rfind(b"\n") + 1]
                if path == self._path and len(whole) < len(tail):
                    file.truncate(size - len(tail) + len(whole))
                if whole:
                    self.last = link(whole[:-1].rpartition(b"\n")[2])
                    break
        self._opened = True

    def _size(self) -> int:
        try:
            return self._path.stat().st_size
        except FileNotFoundError:
            return 0

    def _rotate(self) -> None:
        for number in range(OLDER, 1, -1):
            with suppress(FileNotFoundError):
                _older(self._path, number - 1).replace(_older(self._path, number))
        self._path.replace(_older(self._path, 1))


def read(path: Path) -> Iterator[bytes]:
    """Yields the lines of all files, the oldest first. Raises `OSError`."""
    for one in [*(_older(path, number) for number in range(OLDER, 0, -1)), path]:
        with suppress(FileNotFoundError), one.open("rb") as file:
            for line in file:
                yield line.removesuffix(b"\n")


def _older(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")
