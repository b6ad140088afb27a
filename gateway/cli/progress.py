"""A progress bar on the terminal for work that takes longer than a second."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

AFTER = 1.0  # seconds
Report = Callable[[str, float], None]  # what is done now, and the share of it that is done


@contextmanager
def progress(console: Console, after: float = AFTER) -> Iterator[Report]:
    """Shows reported progress from `after` seconds on, if the console is a terminal.

    The bar is removed at the end.
    """
    if not console.is_terminal or console.is_dumb_terminal:
        yield lambda _what, _share: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    bar = Progress(*columns, console=console, transient=True)
    task = bar.add_task("starting", total=1.0)
    shown = threading.Timer(after, bar.start)
    shown.daemon = True
    shown.start()
    try:
        yield lambda what, share: bar.update(task, description=what, completed=share)
    finally:
        shown.cancel()
        shown.join()  # it may show the bar just now
        bar.stop()
