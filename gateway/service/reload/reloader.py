"""Reads the changed file, refuses a bad one, and tells what became of it."""

import asyncio
import hashlib
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import structlog

from gateway import files as disk
from gateway.config import Config, load
from gateway.config.changes import Difference, needs_restart
from gateway.contract.documents.state import ReloadDocument
from gateway.errors import ConfigError, GatewayError
from gateway.plant.threads import off_loop
from gateway.tags.timestamps import rfc3339

log = structlog.get_logger("gateway")

_EFFECT = "the gateway goes on with the file as it was"
_MOST_LOGGED = 20  # mistakes
READ_WITHIN = 120.0  # seconds: a network file system may hang
_GIT_WITHIN = 5.0  # seconds


class Reloader:
    """The file of the gateway. `current` is the content that the gateway has taken over."""

    def __init__(
        self,
        path: Path,
        current: Config,
        wall: Callable[[], int] = time.time_ns,
        read: Callable[[Path], Config] = load,
    ) -> None:
        self.current = current
        self._load = read
        self.path = path
        self._wall = wall
        self._wanted = asyncio.Event()
        self._asked: list[asyncio.Future[Sequence[str]]] = []  # since the last read began
        self._told: list[asyncio.Future[Sequence[str]]] = []  # of the read that goes on
        self._watch = Watch()
        self._loaded = wall()
        self._count = 0
        self._refused: tuple[int, Sequence[str]] | None = None
        self._revision: str | None = None  # in git, of the file that was taken over
        self._read_revision: str | None = None  # of the file that was read last

    def want(self) -> None:
        """Reads the file again as soon as the reload before has ended."""
        self._wanted.set()

    async def reload(self) -> Sequence[str]:
        """Reads the file again. Returns when it was taken over, or why it was not."""
        end: asyncio.Future[Sequence[str]] = asyncio.get_running_loop().create_future()
        self._asked.append(end)
        self.want()
        return await end

    async def watch(self) -> None:
        """Runs until cancelled: wants a reload after each change, if the file says so."""
        await off_loop(self._note)
        self._revision = self._read_revision
        while True:
            await asyncio.sleep(LOOK_EVERY)
            if self.current.watch:
                files, now = self._files(), time.monotonic()
                if await off_loop(self._watch.changed, files, now):
                    self.want()

    async def next(self) -> Config | None:
        """Waits until a reload is wanted. Returns the content of the file; None: it is refused."""
        await self._wanted.wait()
        self._wanted.clear()
        self._told, self._asked = [*self._told, *self._asked], []
        try:
            found = await off_loop(self._read, within=READ_WITHIN)
        except GatewayError:
            found = [f"{self.path}, or a file that it names, does not answer"]
        if isinstance(found, Config):
            return found
        self.refuse(found)
        return None

    def refuse(self, why: Sequence[str]) -> None:
        """Notes that the file changes nothing, with a sentence for each mistake."""
        self._refused = self._wall(), why
        self._tell(why)
        for sentence in why[:_MOST_LOGGED]:
            log.error("file refused", why=sentence, effect=_EFFECT)
        if len(why) > _MOST_LOGGED:
            log.error(
                "file refused", why=f"and {len(why) - _MOST_LOGGED} more mistakes", effect=_EFFECT
            )

    def accept(self, config: Config, difference: Difference | None = None) -> None:
        """Notes that the gateway has taken over the file."""
        self.current, self._refused = config, None
        self._loaded, self._revision = self._wall(), self._read_revision
        self._tell(())
        self._count += 1
        changes = () if difference is None else difference.devices.values()
        log.info(
            "file reloaded",
            file=str(self.path),
            added=[change.name for change in changes if change.old is None],
            changed=[change.name for change in changes if change.old and change.new],
            removed=[change.name for change in changes if change.new is None],
        )

    def _tell(self, why: Sequence[str]) -> None:
        told, self._told = self._told, []
        for end in told:
            if not end.done():
                end.set_result(why)

    @property
    def says(self) -> str:
        """The state in one line, for the supervisor."""
        if self._refused is None:
            return f"serving {len(self.current.devices)} devices"
        return f"the changed file was refused: {self._refused[1][0]}"

    def document(self) -> ReloadDocument:
        """Returns the state of the file, for the status."""
        at, why = self._refused or (None, ())
        return {
            "file": str(self.path),
            "loaded": rfc3339(self._loaded),
            "digest": self.current.digest,
            "revision": self._revision,
            "reloads": self._count,
            "refused": None if at is None else rfc3339(at),
            "why": [*why[:_MOST_LOGGED]],
        }

    def _note(self) -> None:
        """Notes the files before they are read. Blocks."""
        self._watch.note(self._files())
        self._read_revision = _revision(self.path)

    def _files(self) -> list[Path]:
        return list(dict.fromkeys([self.path, *(sheet.file for sheet in self.current.sheets)]))

    def _read(self) -> Config | list[str]:
        """Returns the content of the file, or what is wrong with it."""
        self._note()
        try:
            config = self._load(self.path)
        except ConfigError as error:
            return str(error).splitlines()
        changed = needs_restart(self.current, config)
        return [f"{self.path}: {one} changed: this needs a restart" for one in changed] or config


def _revision(file: Path) -> str | None:
    """Returns the last commit of a file in git, with `+` if the file was changed since; None: it is
    in no repository, or here is no git. Blocks."""
    git = shutil.which("git")
    if git is None:
        return None
    ask = [git, "-C", str(file.parent), "-c", "core.fsmonitor=false"]
    try:
        commit, changed = (
            subprocess.run(  # noqa: S603  (git, with the name of the file)
                [*ask, *what, "--", file.name],
                capture_output=True,
                text=True,
                timeout=_GIT_WITHIN,
                check=True,
            ).stdout.strip()
            for what in (
                ("log", "-1", "--format=%h", "--abbrev=12"),
                ("diff", "--name-only", "HEAD"),
            )
        )
    except (subprocess.SubprocessError, OSError):
        return None
    return f"{commit}{'+' if changed else ''}" if commit else None


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
