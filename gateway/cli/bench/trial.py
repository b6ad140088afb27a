"""Applies the draft: the file is written, and goes back by itself unless a person keeps it."""

import asyncio
import math
import shutil
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

from gateway import files
from gateway.cli.bench.draft import Draft
from gateway.cli.bench.running import Running
from gateway.cli.sheets.text_file import backup_of, read_file, replace, write_new
from gateway.config import load
from gateway.errors import ConfigError, GatewayError
from gateway.plant.threads import off_loop

CONFIRM_WITHIN = 60.0  # seconds


class Trial:
    """The file until a person keeps it. The file before is beside it until then.

    It also goes back when the bench ends. A bench that was killed leaves the file before beside
    it, and the next bench asks.
    """

    def __init__(
        self,
        draft: Draft,
        running: Running,
        within: float = CONFIRM_WITHIN,
        release: Callable[[], Awaitable[object]] | None = None,
    ) -> None:
        """`release`: has the bench leave every port, before the gateway may open it."""
        self._draft = draft
        self._said = "", ""  # a sentence, and the draft of then
        self._running = running
        self._within = within
        self._release = release
        self._until: float | None = None  # loop time
        self._timer: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()
        if files.is_file(self._before):
            self._until = math.inf

    @property
    def _before(self) -> Path:
        path = self._draft.path.resolve()
        return path.with_name(f"{path.name}.before")

    @property
    def said(self) -> str:
        """The last thing that happened, as a sentence; empty after a later step of the draft."""
        said, draft = self._said
        return said if draft == self._draft.text else ""

    def _say(self, said: str) -> None:
        self._said = said, self._draft.text

    def left(self) -> float | None:
        """Returns the seconds until the file goes back; None: nothing waits; inf: it asks."""
        if self._until is None:
            return None
        return max(0.0, self._until - asyncio.get_running_loop().time())

    async def apply(self) -> None:
        """Writes the draft to the file, and has the gateway take it over. Raises `GatewayError`;
        then the file is as before."""
        async with self._turn:
            if self._until is not None:
                raise ConfigError("keep the change before, or go back, first")
            draft, running = self._draft, self._running
            config = await off_loop(draft.config)
            if why := running.why_not(config):
                raise ConfigError(why)
            is_first, ran, is_new = draft.file is None, bool(running.state), draft.is_new
            if is_new:
                await off_loop(self._write, draft.text)
            if self._release is not None:
                await self._release()
            try:
                await running.take(config)
            except GatewayError:
                if is_new:
                    await self._undo(is_first=is_first, ran=ran)
                raise
            if is_first or not is_new:
                self._say("The gateway runs the file.")
                return
            self._say("The gateway took the change over.")
            self._begin()

    async def keep(self) -> None:
        """Ends the trial: the file stays. Raises `ConfigError`; then it goes back in its time."""
        async with self._turn:
            if self._until is not None:
                await off_loop(_moved, self._before, backup_of(self._draft.path.resolve()))
                self._end()
                self._say("The change is kept.")

    async def back(self, said: str = "The file is as before.") -> None:
        """Ends the trial: the file is as before, and the gateway takes it over. If the file cannot
        be written, the trial goes on, and tries it again."""
        async with self._turn:
            if self._until is None:
                return
            try:
                why_not = await off_loop(self._restore)
            except ConfigError as error:
                self._say(f"The file could not go back: {error}")
                if math.isfinite(self._until):
                    self._begin()
                return
            self._end()
            if why_not:
                self._say(f"The file could not go back: {why_not}")
                return
            try:
                if self._release is not None:
                    await self._release()
                if self._running.state:
                    await self._running.take(await off_loop(load, self._draft.path))
                self._say(said)
            except GatewayError as error:
                self._say(f"The file is as before, and the gateway does not run it: {error}")

    async def close(self) -> None:
        """Goes back if a person has not decided. A question of an earlier bench stays."""
        if self._until is not None and math.isfinite(self._until):
            await self.back()

    async def _later(self) -> None:
        await asyncio.sleep(self._within)
        self._timer = None
        await self.back("The change was not kept: the file is as before.")

    def _begin(self) -> None:
        self._end()
        self._until = asyncio.get_running_loop().time() + self._within
        self._timer = asyncio.create_task(self._later(), name="trial")

    def _end(self) -> None:
        self._until = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    async def _undo(self, *, is_first: bool, ran: bool) -> None:
        """After a refusal: the file is as before, or not there, and a gateway goes on with it."""
        if is_first:
            await off_loop(_removed, self._draft.path)
            self._draft.file = None
            return
        try:
            await off_loop(self._restore)
        except ConfigError:
            self._begin()
            raise
        if ran:
            with suppress(GatewayError):
                await self._running.take(await off_loop(load, self._draft.path))

    def _write(self, text: str) -> None:
        """Raises `ConfigError`."""
        draft = self._draft
        if draft.file is None:
            write_new(draft.path, text)
        else:
            try:
                self._before.touch(exist_ok=False)
                shutil.copy2(draft.path, self._before)
            except FileExistsError:
                raise ConfigError(
                    f"another bench tries a change of {draft.path.name}: keep it, or go back, there"
                ) from None
            except OSError as error:
                with suppress(OSError):  # a full disk took a part of it
                    self._before.unlink()
                raise ConfigError(f"{self._before} cannot be written: {error.strerror}") from None
            try:
                replace(
                    draft.path,
                    draft.file,
                    text,
                    lambda new: load(draft.path, text=new),
                    backup=False,
                )
            except ConfigError:
                _removed(self._before)
                raise
        draft.file = read_file(draft.path)

    def _restore(self) -> str:
        """Returns why the file is to stay; empty: it is as before. Raises `ConfigError`."""
        path = self._draft.path.resolve()
        if read_file(path) != self._draft.file:
            _removed(self._before)
            return f"{path.name} was changed meanwhile, and stays as it is"
        _moved(self._before, path)
        self._draft.file = read_file(path)
        return ""


def _moved(file: Path, to: Path) -> None:
    try:
        file.replace(to)
    except OSError as error:
        raise ConfigError(f"{to} cannot be written: {error.strerror}") from None


def _removed(file: Path) -> None:
    try:
        file.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{file} cannot be removed: {error.strerror}") from None
