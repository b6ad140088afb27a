"""A gateway whose parts and files a test can hurt: `python -m tests.parts.hurt run FILE`.

Orders come on standard input, one a line, and `ok` says that one counts:

    break PART POINT     calls of this method of the part fail; `run` fails at once
    hang PART POINT      calls of this method do not return
    hold PATH            whatever opens, renames, removes or looks at the path waits
    mend                 everything works again

`PART` may be `all`. Orders after `FILE` on the command line, separated by commas, count from the
start.
"""

import asyncio
import os
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from gateway.cli import main
from gateway.parts import registry
from gateway.plant.part import Core, Kind, Part
from gateway.service import bulkheads, service

POINTS = (
    *("restore", "begin", "run", "seen", "publish", "publish_all", "retag", "take_over"),
    *("documents", "faults", "activate", "set_online", "order", "page", "shown"),
)
AWAITED = {"restore", "begin", "publish_all", "take_over", "order"}
OF_FILES = {"open", "os.rename", "os.remove", "os.mkdir", "os.listdir", "sqlite3.connect"}


class Hurt:
    """The harm that is done now."""

    def __init__(self) -> None:
        self.broken: set[tuple[str, str]] = set()
        self.hung: set[tuple[str, str]] = set()
        self.held = ""
        self.free = threading.Event()
        self.runs: dict[str, Callable[[], object]] = {}  # by part: ends its `run` with an error
        self.loop_was_held: list[str] = []

    def order(self, line: str) -> None:
        match line.split():
            case ["break", part, point]:
                self.broken |= {(name, point) for name in self._names(part)}
                if point == "run":
                    for name in self._names(part):
                        self.runs.get(name, lambda: None)()
            case ["hang", part, point]:
                self.hung |= {(name, point) for name in self._names(part)}
            case ["hold", path]:
                self.free.clear()
                self.held = path
            case ["mend"]:
                self.held = ""
                self.broken, self.hung = set(), set()
                self.free.set()

    def _names(self, part: str) -> Sequence[str]:
        return registry.PARTS if part == "all" else [part]

    def meet(self, part: str, point: str) -> None:
        if (part, point) in self.broken:
            raise ZeroDivisionError(f"broken in {point}")

    async def wait_at(self, part: str, point: str) -> None:
        self.meet(part, point)
        while (part, point) in self.hung:
            await asyncio.sleep(0.05)

    def touch(self, path: object) -> None:
        if not self.held or not isinstance(path, str | bytes | os.PathLike):
            return
        if not os.fsdecode(path).startswith(self.held):
            return
        if asyncio._get_running_loop() is not None:
            print("THE LOOP IS HELD", *traceback.format_stack(limit=12), flush=True)
        self.free.wait()


HURT = Hurt()


def kinds() -> list[tuple[str, Kind]]:
    return [(name, hurtable(name, kind)) for name, kind in registry.kinds()]


def hurtable(name: str, kind: Kind) -> Kind:
    def make(core: Core) -> Part | None:
        HURT.meet(name, "make")
        part = kind.make(core)
        for point in POINTS:
            if hasattr(part, point):
                wrap = running if point == "run" else awaited if point in AWAITED else called
                setattr(part, point, wrap(name, point, getattr(part, point)))
        return part

    return Kind(make, kind.phase, kind.serves)


def called(name: str, point: str, method: Callable[..., Any]) -> Callable[..., Any]:
    def hurt(*arguments: Any) -> Any:
        HURT.meet(name, point)
        return method(*arguments)

    return hurt


def awaited(name: str, point: str, method: Callable[..., Any]) -> Callable[..., Any]:
    async def hurt(*arguments: Any) -> Any:
        await HURT.wait_at(name, point)
        return await method(*arguments)

    return hurt


def running(name: str, point: str, method: Callable[..., Any]) -> Callable[..., Any]:
    async def hurt() -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        HURT.runs[name] = partial(loop.call_soon_threadsafe, ended.set)
        HURT.meet(name, point)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(method())
                await ended.wait()
                HURT.meet(name, point)
        except ExceptionGroup as group:
            raise group.exceptions[0] from None
        finally:
            await HURT.wait_at(name, "stop")

    return hurt


def watched(event: str, arguments: tuple[Any, ...]) -> None:
    if event in OF_FILES:
        HURT.touch(arguments[0])


def obey() -> None:
    for line in sys.stdin:
        HURT.order(line)
        print("ok", flush=True)


if __name__ == "__main__":
    *words, orders = sys.argv
    sys.argv = words
    for order in filter(None, orders.split(",")):
        HURT.order(order)
    setattr(service, "kinds", kinds)  # noqa: B010  (mypy: it is no export)
    bulkheads.PAUSE_FIRST = bulkheads.PAUSE_LONGEST = 0.3  # seconds
    sys.addaudithook(watched)
    stat = os.stat

    def held_stat(path: Any, **how: Any) -> os.stat_result:
        HURT.touch(path)
        return stat(path, **how)

    os.stat = held_stat
    threading.Thread(target=obey, daemon=True).start()
    main.main()
