"""A progress bar on the terminal for work that takes longer than a second."""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console

from gateway.cli.terminal import err

if TYPE_CHECKING:
    from gateway.config import Config

AFTER = 1.0  # seconds
COUNTED = 1000  # things between two reports
Report = Callable[[str, float | None], None]  # what is done now; its share, if it is known
_Thing = TypeVar("_Thing")


@contextmanager
def progress(console: Console, after: float = AFTER) -> Iterator[Report]:
    """Shows reported progress from `after` seconds on, if the console is a terminal.

    The bar is removed at the end.
    """
    if not console.is_terminal or console.is_dumb_terminal:
        yield lambda _what, _share: None
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    bar = Progress(*columns, console=console, transient=True)
    task = bar.add_task("starting", total=1.0)
    shown = threading.Timer(after, bar.start)
    shown.daemon = True
    shown.start()

    def report(what: str, share: float | None) -> None:
        # The total of a task cannot be taken away by `update`.
        bar.tasks[0].total = None if share is None else 1.0
        bar.update(task, description=what, completed=share or 0.0)

    try:
        yield report
    finally:
        shown.cancel()
        shown.join()  # it may show the bar just now
        bar.stop()


@contextmanager
def busy(what: str) -> Iterator[Report]:
    """Shows that work of an unknown length goes on."""
    with progress(err) as report:
        report(what, None)
        yield report


def counted(things: Iterable[_Thing], what: str, report: Report) -> Iterator[_Thing]:
    """Yields the things, and reports their number. `what`: such as `rows exported`."""
    for number, thing in enumerate(things):
        if number % COUNTED == 0:
            report(f"{number:,} {what}", None)
        yield thing


def loaded(path: Path) -> "Config":
    """Loads a file with a bar. Raises as `load`."""
    from gateway.config import load  # commands without a file import no protocol

    with progress(err) as report:
        return load(path, report)
