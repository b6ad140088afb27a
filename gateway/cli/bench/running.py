"""The gateway of the file: one that runs already, or one that the bench starts and ends."""

import asyncio
import ctypes
import signal
import sys
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar

from gateway.cli.client import Client, NoGateway, connected
from gateway.cli.run import STARTED
from gateway.config import Config
from gateway.config.changes import needs_restart
from gateway.errors import ConfigError, GatewayError
from gateway.plant.threads import off_loop

T = TypeVar("T")
_LOGGED = 40  # lines
_AGAIN = 0.2  # seconds between two looks
_READY_WITHIN = 60.0  # seconds
_ENDS_WITHIN = 5.0  # less than the bench itself has
_DIES_WITH_PARENT = 1  # of prctl


class Running:
    """The gateway of the file, if one runs, and a session with it.

    A gateway of somebody else is only told of a change by `watch_config` of its file.
    """

    def __init__(self, path: Path) -> None:
        self.log: deque[str] = deque(maxlen=_LOGGED)
        self.config: Config | None = None  # what the gateway has
        self._path = path
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()  # it serves, or has ended
        self._client: Client | None = None
        self._session = ExitStack()

    @property
    def state(self) -> str:
        """`own`, `other`, or empty: none runs."""
        if self._process is not None and self._process.returncode is None:
            return "own"
        return "" if self._client is None or self._process is not None else "other"

    async def look(self, config: Config) -> None:
        """Looks for a gateway of the file that runs already. Raises `GatewayError` for one that
        stands still, or refuses this user: it has the ports."""
        with suppress(NoGateway):
            await self._connect(config)

    async def take(self, config: Config) -> None:
        """Has the gateway take over the file, which was written. Raises `GatewayError` if it does
        not: then it goes on with what it had."""
        old = self.config
        if self.state == "own" and old is not None and needs_restart(old, config):
            await self.end()
        if not self.state:
            await self._start(config)
            return
        before = await self.ask(lambda client: client.status("reload"))
        if self._process is not None:
            self._process.send_signal(signal.SIGHUP)
        await self._wait(lambda client: _taken(client, before))
        await self._connect(config)

    def why_not(self, config: Config) -> str:
        """Returns why the gateway could not take over a file; empty if it can."""
        if self.state != "other" or self.config is None:
            return ""
        if not self.config.watch:
            return (
                "a gateway of this file runs already, and does not watch it: write `watch_config: "
                "true` below `gateway:` and restart it, or end it: then the bench runs one"
            )
        changed = needs_restart(self.config, config)
        return f"{changed[0]} changed: this needs a restart of the gateway" if changed else ""

    async def ask(self, question: Callable[[Client], T]) -> T:
        """Asks the gateway, on a thread. Raises `GatewayError`."""
        if self._client is None or not self.state:
            raise GatewayError("no gateway runs yet: apply the file")
        return await off_loop(question, self._client)

    async def end(self) -> None:
        """Ends the gateway that the bench started, and the session."""
        self._close()
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(ProcessLookupError):
            process.terminate()
        try:
            async with asyncio.timeout(_ENDS_WITHIN):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
        if self._reader is not None:
            await self._reader

    async def _start(self, config: Config) -> None:
        await self.end()
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "gateway", "run", str(self._path)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the bench, which ends it
            preexec_fn=_die_with_parent,
        )
        self._ready.clear()
        self._reader = asyncio.create_task(self._read(self._process))
        try:
            async with asyncio.timeout(_READY_WITHIN):
                if await self._ready.wait() and self.state:
                    await self._connect(config)
                    return
        except (TimeoutError, GatewayError):
            pass
        said = self.log[-1] if self.log else "it said nothing"
        await self.end()
        raise GatewayError(f"the gateway did not start: {said}")

    async def _connect(self, config: Config) -> None:
        """Raises `GatewayError`."""

        def connect() -> tuple[Client, ExitStack]:
            with ExitStack() as stack:
                client = stack.enter_context(connected(config, self.log.append))
                client.status()
                return client, stack.pop_all()
            raise AssertionError

        client, session = await off_loop(connect)
        self._close()
        self._client, self._session, self.config = client, session, config

    def _close(self) -> None:
        self._session.close()
        self._client, self.config = None, None

    async def _wait(self, done: Callable[[Client], bool]) -> None:
        try:
            async with asyncio.timeout(_READY_WITHIN):
                while not await self.ask(done):
                    await asyncio.sleep(_AGAIN)
        except TimeoutError:
            raise GatewayError("the gateway does not take the file over") from None

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        if process.stderr is None:
            return
        while line := await process.stderr.readline():
            self.log.append(line.decode("utf-8", "replace").rstrip())
            if self.log[-1] == STARTED:
                self._ready.set()
        await process.wait()
        self._ready.set()  # it has ended


def _taken(client: Client, before: Mapping[str, Any]) -> bool:
    """Raises `ConfigError` if the file was refused."""
    document: dict[str, Any] = client.status("reload")
    if document["refused"] not in (None, before["refused"]):
        raise ConfigError("\n".join(document["why"]))
    return bool(document["reloads"] != before["reloads"])


def _die_with_parent() -> None:
    """Has Linux end this process with the one that started it, however that ends."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_DIES_WITH_PARENT, signal.SIGTERM)
