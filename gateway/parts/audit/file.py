"""The records of the audit, and their files: one that grows, and older ones.

The records are lines of JSON, each with the hash of the one before. A record that is changed,
moved or taken out breaks the chain. The end can be cut off unseen: compare its hash with the one in
the log. The files block.
"""

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import orjson

from gateway import files
from gateway.contract.past.timerange import LATEST, TimeRange
from gateway.tags.timestamps import rfc3339

_HEAD = re.compile(rb'\{"n":([0-9]{1,18}),"time":"([0-9TZ:.-]{20,30})",')


class Link(NamedTuple):
    """A record as the next one needs it: its number and its hash."""

    number: int = 0
    hash: str = ""


class Event(NamedTuple):
    """An outcome or an acknowledgement, as JSON. `time`: ns since 1970."""

    time: int
    text: str


class Checked(NamedTuple):
    """A record that was read. `why`: the chain is broken here; empty: it is sound."""

    number: int
    time: str
    event: Any
    why: str


def lines(last: Link, events: Iterable[Event]) -> tuple[bytes, Link]:
    """Returns the lines of new records after the last one, and their last."""
    written = []
    for event in events:
        record = {
            "n": last.number + 1,
            "time": rfc3339(event.time),
            "before": last.hash,
            "event": orjson.loads(event.text),
        }
        line = orjson.dumps(record)
        last = Link(last.number + 1, _hash(line))
        written.append(line + b"\n")
    return b"".join(written), last


def link(line: bytes) -> Link:
    """Returns the link to a line, whatever is in it."""
    number = 0
    with suppress(ValueError, TypeError, KeyError):
        number = int(orjson.loads(line)["n"])
    return Link(number, _hash(line))


def checked(found: Iterable[bytes]) -> Iterator[Checked]:
    """Yields the records of lines, the oldest first. The first record that is kept has none before
    it to compare."""
    last: Link | None = None
    for line in found:
        number, time, event, why = 0, "", None, ""
        try:
            record = orjson.loads(line)
            number, time, event = int(record["n"]), str(record["time"]), record["event"]
            if last is not None and record["before"] != last.hash:
                why = f"record {number} does not follow record {last.number} as it is now"
            elif last is not None and number != last.number + 1:
                why = f"record {number} follows record {last.number}"
        except (ValueError, TypeError, KeyError):
            why = f"a line after record {0 if last is None else last.number} is no record"
        last = Link(number, _hash(line))
        yield Checked(number, time, event, why)


def within(found: Iterable[bytes], asked: TimeRange) -> Iterator[tuple[int, bytes]]:
    """Yields the lines of records of a time, as they are in the file, with their numbers."""
    first, last = rfc3339(max(asked.first, 0)), rfc3339(min(asked.last, LATEST))
    for line in found:
        head = _HEAD.match(line)
        if head is not None and first <= head[2].decode() <= last:
            yield int(head[1]), line


def _hash(line: bytes) -> str:
    return hashlib.sha256(line).hexdigest()


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
    """Yields the whole lines of all files, the oldest first, also while records are written.

    Raises `OSError`.
    """
    with ExitStack() as opened:
        found = dict[int, BinaryIO]()  # by inode: a file that was renamed meanwhile is found twice
        for one in [path, *(_older(path, number) for number in range(1, OLDER + 1))]:
            with suppress(FileNotFoundError):
                file: BinaryIO = opened.enter_context(one.open("rb"))
                found.setdefault(os.fstat(file.fileno()).st_ino, file)
        for file in reversed(found.values()):
            for line in file:
                if line.endswith(b"\n"):
                    yield line[:-1]


def _older(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")
