"""Writes the recording of a line: files of limited size, of which the oldest are deleted."""

import os
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Self

from gateway import files
from gateway.errors import GatewayError

FILES = 10  # of one recording: a tenth of it is deleted at once


class Recording:
    """The files of one line in a folder, named after it and the time: `hall-1-20261120T1200….log`.

    Raises `GatewayError` when the disk is full or fails. The last file ends with a whole line.
    """

    def __init__(self, folder: Path, line: str, keep: int, notes: Iterable[str] = ()) -> None:
        """`keep`: bytes of all files together. `notes`: at the begin of each file."""
        self._folder = folder
        self._line = line
        self._note = f"# line {line}\n" + "".join(f"# {note}\n" for note in notes)
        self._most = max(1, keep // FILES)
        self._file: int | None = None
        self._path = folder
        self._size = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._next()
        except OSError as error:
            raise self._failed(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def path(self) -> Path:
        """The file that is written now."""
        return self._path

    def add(self, text: str) -> None:
        """Adds whole lines. A file of any size gets them all."""
        data = text.encode()
        try:
            if self._size and self._size + len(data) > self._most:
                self._next()
            self._write(data)
        except OSError as error:
            raise self._failed(error) from error

    def _write(self, data: bytes) -> None:
        if self._file is None:
            raise AssertionError("no file is open")
        files.append(self._file, data)
        self._size += len(data)

    def _next(self) -> None:
        self._close()
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        while self._file is None:
            now = time.time_ns() // 1000
            stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(now // 10**6))
            self._path = self._folder / f"{self._line}-{stamp}.{now % 10**6:06}.log"
            with suppress(FileExistsError):
                self._file = os.open(self._path, flags, 0o640)
        self._size = 0
        self._write(self._note.encode())
        for old in self._files()[:-FILES]:
            old.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        """Returns the files of this line, the oldest first."""
        named = re.compile(re.escape(self._line) + r"-\d{8}T\d{6}\.\d{6}\.log")
        found = (path for path in self._folder.iterdir() if named.fullmatch(path.name))
        return sorted(found)

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _failed(self, error: OSError) -> GatewayError:
        why = error.strerror or str(error)
        return GatewayError(f"recording ended: {self._path}: {why}; the gateway goes on")
