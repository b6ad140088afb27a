"""Another file from a named writer: checked, loaded, and put back unless somebody confirms it.

What may change is what a reload takes over: lines, devices, tags, transfers. A reload refuses a
change of Zenoh, users, writers, files that the gateway writes, and whom it notifies: those need a
person beside the gateway. A change is on disk before it is loaded, with the way back; so it goes
back after a restart, too. One change at a time; `keep` earlier files.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import orjson
import structlog

from gateway.config import Config
from gateway.config.changes import needs_restart
from gateway.contract import payload
from gateway.contract.documents.fleet import RemoteDocument
from gateway.contract.documents.requests import OutcomeDocument
from gateway.contract.interfaces import Keyed
from gateway.errors import BadValue, Busy, GatewayError, NoHistory, NotAllowed, Unknown
from gateway.parts.remote.folder import Folder
from gateway.parts.remote.orders import Do, Order, parse_order
from gateway.parts.remote.settings import RemoteSection
from gateway.plant.part import Core, Kind, LoadedFile, Part, Phase
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.tags.timestamps import rfc3339

log = structlog.get_logger("gateway")
FILE = "file"  # the path of the one document
DISK_WITHIN = 60.0  # seconds: a network file system may hang
State = Literal["none", "waiting", "confirmed", "reverted", "failed"]


@dataclass(frozen=True, slots=True)
class Change:
    """The last change. Times in ns since 1970."""

    state: State = "none"
    by: str = ""
    at: int = 0
    until: int = 0  # then it goes back
    digest: str = ""
    before: str = ""  # the digest of the file before, and the name of its copy
    copy: str = ""
    why: str = ""


class RemotePart:
    """The change that waits, and the earlier files."""

    def __init__(self, core: Core, settings: RemoteSection, file: LoadedFile) -> None:
        self._core, self._settings, self._file = core, settings, file
        self._folder = Folder(file.path, settings.keep)
        self._saved = SavedFile(settings.path)
        self._change = Change()
        self._earlier: Sequence[str] = ()
        self._news = asyncio.Event()  # a change waits, or no longer
        self._ends_at = 0.0  # by the loop's clock
        self._busy = asyncio.Lock()
        self._active = False

    # -- its life --

    async def restore(self) -> None:
        change = await off_loop(self._last_change, within=DISK_WITHIN)
        self._earlier = await off_loop(self._names, within=DISK_WITHIN)
        if change is not None:
            self._change = change
        if self._change.state == "waiting":
            self._wait()

    def _last_change(self) -> Change | None:
        """Raises `GatewayError` for a file that cannot be read now: a change in it may wait. Then
        this part fails, which is a fault, and is made again."""
        change = self._saved.load(_parsed)
        if change is None and self._settings.path.exists():
            raise GatewayError(f"{self._settings.path} cannot be read: a file in it may wait")
        return change

    def activate(self) -> None:
        self._active = True

    async def run(self) -> None:
        while True:
            self._news.clear()
            waits = self._change.state == "waiting"
            with suppress(TimeoutError):
                async with asyncio.timeout_at(self._ends_at if waits else None):
                    await self._news.wait()
            async with self._busy:
                if self._change.state == "waiting" and not self._left():
                    await self._go_back("nobody confirmed it")

    # -- orders --

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        """Raises `GatewayError`; what it returns is on disk."""
        if path != FILE:
            raise Unknown(f"there is no {payload.short(path)}: the key ends with remote/{FILE}")
        if by not in self._settings.writers:
            raise NotAllowed(f"{by or 'a client without a name'} is none of remote.writers")
        order = parse_order(data)
        if self._busy.locked():
            raise Busy("another order about the file is being carried out")
        async with self._busy:
            try:
                await self._carry_out(order, by)
            except OSError as error:
                raise GatewayError(
                    f"{error.filename or self._file.path}: {error.strerror}"
                ) from None
        return self._document()

    async def _carry_out(self, order: Order, by: str) -> None:
        waits = self._change.state == "waiting"
        match order.do:
            case Do.CHECK:
                await self._checked(await self._wanted(order), order.digest)
            case Do.APPLY | Do.ROLLBACK if waits:
                until = rfc3339(self._change.until)
                raise Busy(f"the file of {self._change.by} waits for confirmation until {until}")
            case Do.APPLY:
                await self._apply(await self._wanted(order), order, by)
            case Do.ROLLBACK:
                await self._apply(await self._text_of(order.digest), order, by)
            case _ if not waits:
                raise BadValue("no file waits for confirmation")
            case Do.REVERT:
                await self._go_back(f"{by} took it back")
            case Do.CONFIRM if order.digest != self._change.digest:
                raise BadValue(f"the file that waits is {self._change.digest}")
            case Do.CONFIRM if order.digest != (running := self._file.current.digest):
                raise BadValue(f"meanwhile a person had the gateway load {running}")
            case Do.CONFIRM:
                await self._note(replace(self._change, state="confirmed", why=f"by {by}"))

    async def _wanted(self, order: Order) -> str:
        if order.patch is None:
            return order.file
        return await off_loop(self._folder.patched, order.patch, within=DISK_WITHIN)

    async def _checked(self, text: str, digest: str) -> Config:
        """Raises `BadValue` with the mistakes, for a file that is not the one of the writer, for
        what only a restart takes over, and for a line that would carry more than it can."""
        found = await off_loop(self._folder.checked, text, within=DISK_WITHIN)
        if digest not in ("", found.digest):
            other = "sheets and templates here, or those of this version, are others"
            raise BadValue(f"here the file is {found.digest}, not {payload.short(digest)}: {other}")
        if changed := needs_restart(self._file.current, found):
            text = "this needs a restart, and a person beside the gateway"
            raise BadValue(f"{', '.join(changed)} changed: {text}")
        if heavier := await off_loop(self._overloads, found, within=DISK_WITHIN):
            raise BadValue("; ".join(heavier))
        return found

    def _overloads(self, found: Config) -> list[str]:
        """Returns a sentence for each line that is overloaded, and more than it is now."""
        lines = [line for line in self._core.plant.forecasts(found) if line.overloaded]
        now = self._core.plant.forecasts(self._file.current) if lines else ()
        loads = {line.name: line.load for line in now}
        return [line.advice() for line in lines if line.load > loads.get(line.name, 0.0)]

    async def _text_of(self, digest: str) -> str:
        for kept in reversed(await off_loop(self._folder.earlier, within=DISK_WITHIN)):
            if kept.digest == digest:
                return await off_loop(self._folder.text, kept.file, within=DISK_WITHIN)
        raise Unknown(f"there is no earlier file {payload.short(digest)}")

    async def _apply(self, text: str, order: Order, by: str) -> None:
        if not self._active:
            raise Busy("this gateway stands by: the active one takes a file")
        found, running = await self._checked(text, order.digest), self._file.current.digest
        if found.digest == running:
            raise BadValue("the gateway runs a file with these settings already")
        if await off_loop(self._folder.digest, within=DISK_WITHIN) != running:
            raise BadValue("the file on disk was changed and not loaded: a person works on it")
        now = self._core.plant.wall()
        copy = await off_loop(self._folder.keep, running, now, within=DISK_WITHIN)
        seconds = order.confirm or self._settings.confirm
        until = now + round(seconds * 1e9)
        last = self._change
        try:
            await self._note(Change("waiting", by, now, until, found.digest, running, copy))
        except GatewayError:
            self._change = last
            raise
        self._wait()
        try:
            await off_loop(self._folder.put, text.encode(), within=DISK_WITHIN)
        except OSError as error:
            await self._note(replace(self._change, state="reverted", why=f"{error.strerror}"))
            raise
        if why := await self._file.reload():
            await self._go_back(why[0])
            raise BadValue("; ".join(why[:3]))
        log.warning("file taken over", by=by, digest=found.digest, goes_back=rfc3339(until))

    async def _go_back(self, why: str) -> None:
        """Puts the file before in its place, and loads it. A file that a person changed meanwhile
        is left alone."""
        change = self._change
        on_disk = await off_loop(self._folder.digest, within=DISK_WITHIN)
        if on_disk not in (change.digest, change.before):
            why = f"{why}; the file on disk is another one and was left alone"
            await self._note(replace(change, state="failed", why=why))
            return
        if on_disk != change.before:
            await off_loop(self._folder.put_back, change.copy, within=DISK_WITHIN)
        if mistakes := await self._file.reload():
            why = f"{why}; the file before is back on disk, and was not loaded: {mistakes[0]}"
            await self._note(replace(change, state="failed", why=why))
            return
        log.warning("file went back", why=why, digest=change.before)
        await self._note(replace(change, state="reverted", why=why))

    def _wait(self) -> None:
        """Has the change wait. A clock that jumped makes no wait longer than was asked for."""
        change, now = self._change, self._core.plant.wall()
        seconds = min(max(0, change.until - now), change.until - change.at) / 1e9
        self._ends_at = asyncio.get_running_loop().time() + seconds
        self._news.set()

    def _left(self) -> float:
        return max(0.0, self._ends_at - asyncio.get_running_loop().time())

    async def _note(self, change: Change) -> None:
        """Returns when it is on disk. Raises `GatewayError`."""
        self._change = change
        if change.state != "waiting":
            self._news.set()
        await off_loop(self._saved.save, orjson.dumps(asdict(change)), within=DISK_WITHIN)
        self._earlier = await off_loop(self._names, within=DISK_WITHIN)
        now = self._core.plant.wall()
        event: OutcomeDocument = {
            "key": f"remote/{FILE}",
            "value": change.digest,
            "time": rfc3339(now),
            "took": 0.0,
            "by": change.by,
            "outcome": "obeyed",
            "answer": f"{change.state} {change.why}".strip(),
        }
        self._core.others.audit(now, payload.document(event).decode())
        if self._saved.trouble:
            raise GatewayError(f"{self._settings.path}: {self._saved.trouble}")

    def _names(self) -> Sequence[str]:
        return [kept.digest for kept in self._folder.earlier()]

    # -- its document --

    def document(self) -> RemoteDocument:
        change = self._change
        waits = change.state == "waiting"
        return {
            "state": change.state,
            "by": change.by,
            "at": rfc3339(change.at) if change.at else None,
            "until": rfc3339(change.until) if waits else None,
            "digest": change.digest,
            "before": change.before,
            "why": change.why,
            "earlier": [*self._earlier],
        }

    def _document(self) -> bytes:
        return payload.document(self.document())

    def documents(self) -> Mapping[str, RemoteDocument]:
        return {f"remote/{FILE}": self.document()}

    def entries(self) -> Sequence[tuple[str, Callable[[], bytes]]]:
        return [(FILE, self._document)]

    def recorded(self, time_range: str, now: int) -> Iterator[tuple[str, str]]:
        raise NoHistory


def _parsed(found: Any) -> Change:
    """Raises `TypeError`, `ValueError`."""
    change = Change(**found)
    if not isinstance(change.until, int) or Path(change.copy).name != change.copy:
        raise ValueError("this is no change")
    return change


def _make(core: Core) -> Part | None:
    settings = core.config.part(RemoteSection)
    return None if settings is None or core.file is None else RemotePart(core, settings, core.file)


KIND = Kind(_make, Phase.SHOWING, serves=Keyed)
