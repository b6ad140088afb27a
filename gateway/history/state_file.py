"""What was learned of the devices, kept in a small file across restarts.

The file says which addresses each device refuses and where its requests must be cut, so that a
search is made once and not after every start. Lost or spoilt it costs nothing but a new search.
"""

import os
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import orjson
import structlog

from gateway.engine.device import Device
from gateway.planning.bad_addresses import KnownBad
from gateway.protocols.driver import Span

log = structlog.get_logger("gateway")
FORM = 1
LATEST = 2**63 - 1  # ns since 1970: the year 2262


class Notebook:
    """One file, and a thread that writes it: a disk that stands still holds up nobody."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written: bytes | None = None
        self._trouble: str | None = None
        self._pages: SimpleQueue[bytes | None] = SimpleQueue()  # None: the last was before
        self._thread = threading.Thread(target=self._save_all, name="state", daemon=True)

    # -- any thread --

    def recall(self, devices: Iterable[Device]) -> None:
        """Plan the devices around what is known. A file that cannot be read is moved aside."""
        known = self._read()
        for device in devices:
            if (learned := known.get(device.name)) is not None:
                device.refusals.restore(learned, device.tags)
                device.plan()

    def page(self, devices: Iterable[Device]) -> bytes:
        """What there is to keep now."""
        return orjson.dumps(
            {
                "form": FORM,
                "devices": {d.name: _written(d.refusals.known()) for d in devices},
            },
            option=orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS,
        )

    def start(self) -> None:
        """Begins to write what `keep` and `end` are given."""
        self._thread.start()

    def keep(self, page: bytes) -> None:
        """Never waits. While a page waits for the disk none is added: a later one says it all."""
        if self._pages.empty():
            self._pages.put(page)

    def end(self, page: bytes) -> None:
        """Never waits: the last page, which `close` waits for."""
        self._pages.put(page)
        self._pages.put(None)

    def close(self, within: float) -> bool:
        """Blocks, at most so many seconds; whether the thread has come to its end."""
        if self._thread.ident is None:  # never started
            return True
        self._thread.join(max(0.0, within))
        return not self._thread.is_alive()

    # -- its own thread --

    def _save_all(self) -> None:
        while (page := self._pages.get()) is not None:
            self.save(page)

    def save(self, page: bytes) -> None:
        """Put the page in the file's place, whole or not at all. Trouble is logged, once."""
        if page == self._written:
            return
        beside = self._path.with_name(self._path.name + ".new")
        try:
            with beside.open("wb") as file:
                file.write(page)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._path)
        except OSError as error:
            if self._trouble != str(error):
                self._trouble = str(error)
                log.warning("nothing kept for a restart", file=str(self._path), why=str(error))
            return
        self._written, self._trouble = page, None

    # -- when it is read --

    def _read(self) -> Mapping[str, KnownBad]:
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("nothing known from before", file=str(self._path), why=str(error))
            return {}
        try:
            return _pages(orjson.loads(data))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self._move_aside(repr(error))
            return {}

    def _move_aside(self, why: str) -> None:
        aside = self._path.with_name(self._path.name + ".bad")
        try:
            self._path.replace(aside)
        except OSError as error:
            log.warning("spoilt", file=str(self._path), why=why, not_moved_aside=str(error))
        else:
            log.warning("spoilt, moved aside", file=str(self._path), to=str(aside), why=why)


def _pages(document: Mapping[str, Any]) -> dict[str, KnownBad]:
    if document["form"] != FORM:
        raise ValueError(f"form {document['form']} is not {FORM}")
    return {name: _learned(page) for name, page in document["devices"].items()}


def _written(learned: KnownBad) -> dict[str, object]:
    return {
        "refused": [
            {"area": area, "start": start, "size": size, "since": since, "code": code}
            for (area, start, size), since, code in learned.refused
        ],
        "cuts": [[area, number] for area, number in learned.cuts],
    }


def _learned(page: Mapping[str, list[Mapping[str, object]]]) -> KnownBad:
    """Raises ValueError, TypeError, KeyError for what is no page of ours."""
    refused = tuple(
        (
            Span(str(row["area"]), int(str(row["start"])), int(str(row["size"]))),
            _time(str(row["since"])),
            str(row["code"]),
        )
        for row in page["refused"]
    )
    cuts = tuple((str(area), int(number)) for area, number in page["cuts"])
    return KnownBad(refused, cuts)


def _time(text: str) -> int:
    """ns since 1970. Raises ValueError for what could not be shown."""
    time = int(text)
    if not 0 <= time <= LATEST:
        raise ValueError(f"{text} is no time")
    return time
