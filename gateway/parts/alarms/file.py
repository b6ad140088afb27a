"""The alarm file: alarms that are not normal, kept across restarts."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import orjson
import structlog

from gateway.errors import Busy, GatewayError
from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.machine import Acknowledgement, State, Status, Suppression
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.tags import Level
from gateway.values import Value

log = structlog.get_logger("gateway")
FORMAT = 1
LATEST = 2**63 - 1  # ns since 1970: the year 2262
CLOSE_WITHIN = 0.5  # seconds
TOGETHER = 0.05  # seconds in which changes are saved together
AGAIN_FIRST, AGAIN_LONGEST = 0.5, 5.0  # seconds between two tries of a disk that fails
KEPT_WITHIN = 2.0  # seconds that an operator waits for the disk


class AlarmFile:
    """Restores the alarms, and saves each change. A disk that fails is tried again."""

    def __init__(self, path: Path | None, alarms: Alarms) -> None:
        """Without `path` a restart forgets the alarms."""
        self._file = None if path is None else SavedFile(path)
        self._alarms = alarms
        self._waiting: list[asyncio.Future[None]] = []  # for the next save
        self._began: float | None = None  # the present save, by the loop's clock

    @property
    def trouble(self) -> str:
        """Why the last change is not on disk; empty: it is, or soon will be."""
        now = asyncio.get_running_loop().time()
        if self._began is not None and now > self._began + KEPT_WITHIN:
            return "the disk does not answer"
        return (self._file and self._file.trouble) or ""

    async def restore(self) -> None:
        """Call it before the lines begin."""
        if self._file is not None:
            self._alarms.restore(await off_loop(self._load))

    def _load(self) -> Mapping[str, Status]:
        return (None if self._file is None else self._file.load(parse)) or {}

    async def keep(self) -> None:
        """Returns when the present state is on disk. Raises `Busy` if that takes too long."""
        if self._file is None:
            return
        kept = asyncio.get_running_loop().create_future()
        self._waiting.append(kept)
        self._alarms.changed.set()
        try:
            async with asyncio.timeout(KEPT_WITHIN):
                await kept
        except TimeoutError:
            why = self.trouble or "the disk is slow"
            raise Busy(f"it counts, but is not on disk: {why}. Send it again") from None

    @asynccontextmanager
    async def kept(self) -> AsyncIterator[None]:
        """Saves each change, and the last ones at the end."""
        if self._file is None:
            yield
            self._alarms.close()
            return
        saves = asyncio.create_task(self._save_changes(self._file))
        try:
            yield
        finally:
            self._alarms.close()
            saves.cancel()
            last = snapshot(self._alarms.statuses())
            try:
                await off_loop(self._file.save, last, within=CLOSE_WITHIN)
            except GatewayError:
                log.warning("alarm file close timed out")

    async def _save_changes(self, file: SavedFile) -> None:
        changed, again = self._alarms.changed, AGAIN_FIRST
        while True:
            await changed.wait()
            changed.clear()
            waiting, self._waiting = self._waiting, []
            self._began = asyncio.get_running_loop().time()
            await off_loop(file.save, snapshot(self._alarms.statuses()))
            self._began = None
            if file.trouble is None:
                for one in waiting:
                    if not one.done():
                        one.set_result(None)
                await asyncio.sleep(TOGETHER)
                again = AGAIN_FIRST
            else:
                self._waiting += [one for one in waiting if not one.done()]
                changed.set()
                await asyncio.sleep(again)
                again = min(2 * again, AGAIN_LONGEST)


def snapshot(statuses: Mapping[str, Status]) -> bytes:
    """Returns the content of the file."""
    alarms = {
        key: {
            **status._asdict(),
            "value": _plain(status.value),
            "acknowledged": status.acknowledged and status.acknowledged._asdict(),
            "suppressed": status.suppressed and status.suppressed._asdict(),
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
        folded=entry.get("folded") is True,
        suppressed=_suppression(entry.get("suppressed")),
    )


def _suppression(known: Mapping[str, Any] | None) -> Suppression | None:
    if known is None:
        return None
    until = known["until"]
    return Suppression(
        str(known["by"]),
        _time(known["time"]),
        str(known["reason"]),
        None if until is None else _time(until),
        known["via"],
    )


def _plain(value: Value | None) -> Value | None:
    """Leaves out what JSON cannot hold: the value only informs."""
    is_plain = isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**53)
    return value if is_plain else None


def _time(known: object) -> int:
    if not isinstance(known, int) or not 0 <= known <= LATEST:
        raise ValueError(f"{known!r} is no time")
    return known
