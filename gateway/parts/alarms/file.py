"""The alarm file: alarms that are not normal, kept across restarts."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import orjson
import structlog

from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.machine import Acknowledgement, State, Status
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.tags import Level
from gateway.values import Value

log = structlog.get_logger("gateway")
FORMAT = 1
LATEST = 2**63 - 1  # ns since 1970: the year 2262
CLOSE_WITHIN = 0.5  # seconds
TOGETHER = 0.1  # seconds in which changes are saved together


class AlarmFile:
    """Restores the alarms, and saves each change."""

    def __init__(self, path: Path | None, alarms: Alarms) -> None:
        """Without `path` a restart forgets the alarms."""
        self._file = None if path is None else SavedFile(path)
        self._alarms = alarms

    async def restore(self) -> None:
        """Call it before the lines begin."""
        if self._file is not None:
            self._alarms.restore(await off_loop(self._load))

    def _load(self) -> Mapping[str, Status]:
        return (None if self._file is None else self._file.load(parse)) or {}

    @asynccontextmanager
    async def kept(self) -> AsyncIterator[None]:
        """Saves each change, and the last ones at the end."""
        file = self._file
        if file is not None:
            file.start()
        saves = None if file is None else asyncio.create_task(self._save_changes(file))
        try:
            yield
        finally:
            self._alarms.close()
            if file is not None and saves is not None:
                saves.cancel()
                file.save_last(snapshot(self._alarms.statuses()))
                if not await off_loop(file.close, CLOSE_WITHIN):
                    log.warning("alarm file close timed out")

    async def _save_changes(self, file: SavedFile) -> None:
        changed = self._alarms.changed
        while True:
            await changed.wait()
            changed.clear()
            if not file.save_soon(snapshot(self._alarms.statuses())):
                changed.set()  # the thread is busy
            await asyncio.sleep(TOGETHER)


def snapshot(statuses: Mapping[str, Status]) -> bytes:
    """Returns the content of the file."""
    alarms = {
        key: {
            **status._asdict(),
            "value": _plain(status.value),
            "acknowledged": status.acknowledged and status.acknowledged._asdict(),
        }
        for key, status in statuses.items()
    }
    options = orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS
    return orjson.dumps({"form": FORMAT, "alarms": alarms}, option=options)


def parse(document: Any) -> dict[str, Status]:
    """Raises ValueError, TypeError, KeyError, AttributeError for a damaged file."""
    if document["form"] != FORMAT:
        raise ValueError(f"form {document['form']} is not {FORMAT}")
    return {str(key): _status(entry) for key, entry in document["alarms"].items()}


def _status(entry: Mapping[str, Any]) -> Status:
    by = entry["acknowledged"]
    return Status(
        state=State(entry["state"]),
        level=None if entry["level"] is None else Level(entry["level"]),
        since=_time(entry["since"]),
        raised=_time(entry["raised"]),
        value=_plain(entry["value"]),
        acknowledged=None
        if by is None
        else Acknowledgement(str(by["by"]), _time(by["time"]), by["via"]),
    )


def _plain(value: Value | None) -> Value | None:
    """Leaves out what JSON cannot hold: the value only informs."""
    is_plain = isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**53)
    return value if is_plain else None


def _time(known: object) -> int:
    if not isinstance(known, int) or not 0 <= known <= LATEST:
        raise ValueError(f"{known!r} is no time")
    return known
