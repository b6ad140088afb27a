"""Shows a view of the gateway again every second, for `--watch`."""

import time
from collections.abc import Callable
from contextlib import nullcontext, suppress

from rich.console import RenderableType
from rich.live import Live
from rich.text import Text

from gateway.cli.terminal import out, printable
from gateway.errors import GatewayError

EVERY = 1.0  # seconds


def repeated(view: Callable[[], RenderableType]) -> None:
    """Shows it until Ctrl-C. A gateway that does not answer is shown too."""
    live = Live(console=out, auto_refresh=False) if out.is_terminal else None
    with suppress(KeyboardInterrupt), live or nullcontext():
        while True:
            try:
                shown = view()
            except GatewayError as error:
                shown = Text(printable(str(error)), style="red")
            if live is None:
                out.print(shown)
            else:
                live.update(shown, refresh=True)
            time.sleep(EVERY)
