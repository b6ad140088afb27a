"""Notification as a part: looks at the alarms, writes messages, and sends them on each way.

A message is sent at least once: after a crash, or an answer that came too late, twice with the same
`id`. What waits and what was sent is kept in a file.
"""

import asyncio
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import orjson
import structlog

from gateway.contract.documents.catalogue import in_status
from gateway.errors import LineDown
from gateway.parts.notify.message import Message, message
from gateway.parts.notify.outbox import NotifyDocument, Outbox
from gateway.parts.notify.settings import NotifySection, rules_of
from gateway.parts.notify.watch import Alarm, Told, Watch
from gateway.parts.notify.ways import ways, why_not_sent
from gateway.plant.part import Core, Kind, Listed, Part
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.tags.timestamps import rfc3339

log = structlog.get_logger("gateway")
FORMAT = 1
LOOK_EVERY = 1.0  # seconds
READ_EVERY = 10.0  # seconds: values change without an event
MOST_ALARMS = 2000  # of the list: those without acknowledgement first, then by priority
STOPPED_AFTER = 10.0  # seconds: a part that fails once works again earlier
AGAIN_FIRST, AGAIN_LONGEST = 2.0, 60.0  # seconds between two tries
CLOSE_WITHIN = 0.5  # seconds
# The alarm while no part has alarms. That part goes on with it, and says its end.
_STOPPED = {
    "alarm": "gateway:part-stopped",
    "state": "active",
    "level": "fault",
    "value": True,
    "priority": "critical",
    "text": "a part of the gateway stopped",
    "detail": "alarms stopped: no alarm is raised until that part works again",
}
# By rule and alarm: when it was raised, when it was sent (ns since 1970), whether its end was.
_ToldByRule = dict[str, dict[str, tuple[str, int, bool]]]


class NotifyPart:
    """All rules and ways of the file. Belongs to the event loop."""

    def __init__(self, core: Core, settings: NotifySection) -> None:
        self._core = core
        self._ways = ways(settings, self._ring)
        self._language = settings.language
        self._boxes = {way: Outbox(settings.keep) for way in self._ways}
        self._filled = {way: asyncio.Event() for way in self._ways}
        self._watches = [Watch(rule) for rule in rules_of(settings)]
        self._file = SavedFile(settings.path)
        self._unsaved = False
        self._alarms: Mapping[str, Alarm] = {}  # those that are not normal
        self._read: tuple[object, ...] = ()  # list and change of the last read
        self._read_at = -READ_EVERY
        self._stopped: Alarm = {}
        self._stopped_at: float | None = None  # by the clock of the loop

    # -- life --

    async def begin(self) -> None:
        if (known := await off_loop(self._file.load, _parse)) is None:
            return
        told, waiting = known
        now, wall = asyncio.get_running_loop().time(), self._core.plant.wall()
        for watch in self._watches:
            for key, (raised, at, ended) in told.get(watch.rule.key, {}).items():
                watch.told[key] = Told(raised, now - max(0, wall - at) / 1e9, ended)
        for way, box in self._boxes.items():
            box.restore(waiting.get(way, ()), now)

    async def run(self) -> None:
        self._file.start()
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._look())
                for way in self._ways:
                    tasks.create_task(self._send_all(way))
        finally:
            self._file.save_last(self._snapshot())
            if not await off_loop(self._file.close, CLOSE_WITHIN):
                log.warning("notify file close timed out", effect="a message may be sent twice")

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        found: dict[str, Mapping[str, object]] = {
            f"notify/{way}": box.document() for way, box in self._boxes.items()
        }
        return {**found, "files/notify": {"trouble": self._file.trouble or ""}}

    # -- messages --

    async def _look(self) -> None:
        while True:
            if found := self._core.others.each(Listed):
                await self._read_alarms(found[0])
                self._stopped_at = None
                self._apply(self._alarms, found[0].one)
            else:
                self._apply(self._without_list(), _as_before)
            is_due = self._unsaved or self._file.trouble  # a disk that was full may have room
            if is_due and self._file.save_soon(self._snapshot()):
                self._unsaved = False
            await asyncio.sleep(LOOK_EVERY)

    async def _read_alarms(self, listed: Listed) -> None:
        now, version = asyncio.get_running_loop().time(), (listed, listed.changes)
        if version == self._read and now - self._read_at < READ_EVERY:
            return
        page = await off_loop(listed.page, "open", None, MOST_ALARMS)
        self._alarms = {str(one["alarm"]): one for one in page["alarms"]}
        self._read, self._read_at = version, now

    def _without_list(self) -> Mapping[str, Alarm]:
        """Returns the alarm that there are no alarms now, unless it is too early to tell."""
        now, wall = asyncio.get_running_loop().time(), self._core.plant.wall()
        if self._stopped_at is None:
            self._stopped_at, self._stopped = now, {**_STOPPED, "raised": rfc3339(wall)}
        is_told = now - self._stopped_at >= STOPPED_AFTER
        return {self._stopped["alarm"]: self._stopped} if is_told else {}

    def _apply(self, alarms: Mapping[str, Alarm], gone: Callable[[str], Alarm | None]) -> None:
        now, wall = asyncio.get_running_loop().time(), self._core.plant.wall()
        clock = datetime.fromtimestamp(wall / 1e9, UTC).astimezone()
        config = self._core.config
        for watch in self._watches:
            if notices := watch.look(alarms, gone, now, clock):
                new = message(config.zenoh.prefix, config.name, notices, wall, self._language)
                for way in watch.rule.to:
                    self._boxes[way].put(new, now)
                    self._filled[way].set()
                self._unsaved = True

    async def _ring(self, line: str, number: str) -> None:
        found = next((one for one in self._core.plant.lines if one.name == line), None)
        if found is None:
            raise LineDown(f"line {line} is not served now")
        await found.ring(number)

    async def _send_all(self, way: str) -> None:
        box, again, loop = self._boxes[way], AGAIN_FIRST, asyncio.get_running_loop()
        while True:
            waiting = box.first(loop.time())
            if waiting is None:
                self._filled[way].clear()
                await self._filled[way].wait()
                continue
            why = await why_not_sent(self._ways[way], waiting)
            self._unsaved = True
            if not why:
                box.sent(waiting, self._core.plant.wall())
                log.info("alarm message sent", way=way, id=waiting.id, subject=waiting.subject)
                again = AGAIN_FIRST
                continue
            if box.not_sent(why):
                log.warning("alarm message not sent", way=way, id=waiting.id, why=why)
            await asyncio.sleep(again)
            again = min(2 * again, AGAIN_LONGEST)

    # -- the file --

    def _snapshot(self) -> bytes:
        now, wall = asyncio.get_running_loop().time(), self._core.plant.wall()
        told = {
            watch.rule.key: {
                key: (one.raised, wall - round((now - one.at) * 1e9), one.ended)
                for key, one in watch.told.items()
            }
            for watch in self._watches
        }
        waiting = {way: box.saved(now) for way, box in self._boxes.items()}
        return orjson.dumps({"form": FORMAT, "told": told, "waiting": waiting})


def _as_before(_key: str) -> Alarm:
    """Returns that the alarm has not ended: it is not known."""
    return {"state": "active"}


def _parse(document: Any) -> tuple[_ToldByRule, dict[str, list[tuple[Message, float]]]]:
    """Raises ValueError, TypeError, KeyError, AttributeError for a damaged file."""
    if document["form"] != FORMAT:
        raise ValueError(f"form {document['form']} is not {FORMAT}")
    told = {
        rule: {
            key: (str(raised), int(at), ended is True) for key, (raised, at, ended) in known.items()
        }
        for rule, known in document["told"].items()
    }
    waiting = document["waiting"].items()
    return told, {
        way: [(Message.restored(one), max(0.0, float(one.get("waited", 0)))) for one in found]
        for way, found in waiting
    }


def _make(core: Core) -> Part | None:
    settings = core.config.part(NotifySection)
    return None if settings is None else NotifyPart(core, settings)


KIND = Kind(_make, documents=(in_status("notify/{way}", NotifyDocument),))
