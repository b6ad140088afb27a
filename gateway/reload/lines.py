"""The tasks of the lines: a reload starts and ends some of them."""

import asyncio
from collections.abc import Coroutine

from gateway.line.line import Line


class RunningLines:
    """One task for each line. `failed` is set when one ends by itself."""

    def __init__(self) -> None:
        self.failed = asyncio.Event()
        self.started = False
        self._tasks: dict[Line, asyncio.Task[None]] = {}

    def start(self, line: Line, work: Coroutine[None, None, None] | None = None) -> None:
        """Runs the line. `work` runs it after it is planned."""
        self.started = True
        task = asyncio.create_task(work or line.run(), name=line.engine.name)
        self._tasks[line] = task
        task.add_done_callback(lambda ended: self._ended(line, ended))

    async def end(self, line: Line) -> None:
        """Ends the line. Returns when its port is closed."""
        task = self._tasks.pop(line)
        task.cancel()
        await asyncio.wait([task])

    async def end_all(self) -> None:
        """Ends every line. Raises the error of one that failed."""
        tasks, self._tasks = [*self._tasks.values()], {}
        for task in tasks:
            task.cancel()
        for outcome in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(outcome, Exception):
                raise outcome

    def _ended(self, line: Line, task: asyncio.Task[None]) -> None:
        if self._tasks.get(line) is task:
            self.failed.set()
