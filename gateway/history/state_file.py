"""The state file: what a gateway has learned of its devices, kept across restarts.

It holds the addresses that each device refuses and the places where its requests must be split, so
that the search for them is made once and not after every start. Without the file, or with a
damaged one, the search is made again. It also holds the totals of counters, which then begin again.
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
from gateway.tags.kept import CounterState

log = structlog.get_logger("gateway")
FORMAT = 1
LATEST = 2**63 - 1  # ns since 1970: the year 2262
_Content = tuple[Mapping[str, KnownBad], Mapping[str, CounterState]]


class StateFile:
    """One file, and a thread that writes it, so that a stalled disk delays nothing else."""

    def __init__(self, path: Path) -> None:
        self.counters: Mapping[str, CounterState] = {}  # as `restore` has read them
        self._path = path
        self._saved: bytes | None = None
        self._trouble: str | None = None
        self._queue: SimpleQueue[bytes | None] = SimpleQueue()  # None ends the thread
        self._thread = threading.Thread(target=self._save_all, name="state", daemon=True)

    # -- any thread --

    def restore(self, devices: Iterable[Device]) -> None:
        """Restores what the file knows of the devices, and plans again those that have a plan.

        Moves a file aside that cannot be parsed.
        """
        learned_by_name, self.counters = self._load()
        for device in devices:
            if (learned := learned_by_name.get(device.name)) is not None:
                device.bad_addresses.restore(learned, device.tags)
                if device.blocks:
                    device.plan()

    def snapshot(
        self, devices: Iterable[Device], counters: Mapping[str, CounterState] | None = None
    ) -> bytes:
        """Returns the content of the file for the present state of the devices."""
        return orjson.dumps(
            {
                "form": FORMAT,
                "devices": {d.name: _to_json(d.bad_addresses.known()) for d in devices},
                "counters": {
                    key: list(state) for key, state in {**self.counters, **(counters or {})}.items()
                },
            },
            option=orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS,
        )

    def start(self) -> None:
        """Starts the thread that saves."""
        self._thread.start()

    def save_soon(self, snapshot: bytes) -> None:
        """Never waits. Ignored while another snapshot waits: a later one holds everything."""
        if self._queue.empty():
            self._queue.put(snapshot)

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

    # -- its own thread --

    def _save_all(self) -> None:
        while (snapshot := self._queue.get()) is not None:
            self.save(snapshot)

    def save(self, snapshot: bytes) -> None:
        """Replaces the file, completely or not at all. Logs each kind of trouble once."""
        if snapshot == self._saved:
            return
        temporary = self._path.with_name(self._path.name + ".new")
        try:
            with temporary.open("wb") as file:
                file.write(snapshot)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self._path)
        except OSError as error:
            if self._trouble != str(error):
                self._trouble = str(error)
                log.warning("state file not saved", file=str(self._path), why=str(error))
            return
        self._saved, self._trouble = snapshot, None

    # -- loading --

    def _load(self) -> _Content:
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            return {}, {}
        except OSError as error:
            log.warning("state file not read", file=str(self._path), why=str(error))
            return {}, {}
        try:
            return _parse(orjson.loads(data))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self._move_aside(repr(error))
            return {}, {}

    def _move_aside(self, why: str) -> None:
        aside = self._path.with_name(self._path.name + ".bad")
        try:
            self._path.replace(aside)
        except OSError as error:
            log.warning("state file damaged", file=str(self._path), why=why, not_moved=str(error))
        else:
            log.warning("state file damaged", file=str(self._path), why=why, moved_to=str(aside))


def _parse(document: Mapping[str, Any]) -> _Content:
    if document["form"] != FORMAT:
        raise ValueError(f"form {document['form']} is not {FORMAT}")
    devices = {name: _from_json(entry) for name, entry in document["devices"].items()}
    counters = {
        str(key): CounterState(int(last), int(total))
        for key, (last, total) in document.get("counters", {}).items()
    }
    return devices, counters


def _to_json(learned: KnownBad) -> dict[str, object]:
    return {
        "refused": [
            {"area": area, "start": start, "size": size, "since": since, "code": code}
            for (area, start, size), since, code in learned.refused
        ],
        "cuts": [[area, number] for area, number in learned.cuts],
    }


def _from_json(entry: Mapping[str, list[Mapping[str, object]]]) -> KnownBad:
    """Raises ValueError, TypeError, KeyError if the entry is damaged."""
    refused = tuple(
        (
            Span(str(row["area"]), int(str(row["start"])), int(str(row["size"]))),
            _time(str(row["since"])),
            str(row["code"]),
        )
        for row in entry["refused"]
    )
    cuts = tuple((str(area), int(number)) for area, number in entry["cuts"])
    return KnownBad(refused, cuts)


def _time(text: str) -> int:
    """Parses ns since 1970. Raises ValueError outside the years that can be shown."""
    time = int(text)
    if not 0 <= time <= LATEST:
        raise ValueError(f"{text} is no time")
    return time
