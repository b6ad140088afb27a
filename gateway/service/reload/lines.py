"""The tasks of the lines: a reload starts and ends some of them."""

import asyncio
from collections.abc import Coroutine


class RunningLines:
    """One task for each line. `failed` is set when one ends by itself."""

    def __init__(self) -> None:
        self.failed = asyncio.Event()
        self.started = False
        self._tasks: dict[object, asyncio.Task[None]] = {}  # by line

    def start(self, line: object, name: str, work: Coroutine[None, None, None]) -> None:
        """Starts the task `work` of a line, which may plan it first."""
        self.started = True
        task = asyncio.create_task(work, name=name)
        self._tasks[line] = task
        task.add_done_callback(lambda ended: self._ended(line, ended))

    async def end(self, line: object) -> None:
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

    def _ended(self, line: object, task: asyncio.Task[None]) -> None:
        if self._tasks.get(line) is task:
            self.failed.set()
