"""The wire log: every byte on a line with its time, for the log, for traces and for tests.

A line of the log is `12.345678 > 02 30 30 ...` (sent) or has `<` (received). Times are seconds
of the line's clock.
"""

import logging
from collections.abc import Callable

log = logging.getLogger("gateway.wire")
Listener = Callable[[str, bytes], None]


class WireLog:
    """Passes the bytes of one line to its listeners and to the debug log."""

    __slots__ = ("_listeners", "active", "line")

    def __init__(self, line: str) -> None:
        self.line = line
        self._listeners: list[Listener] = []
        self.active = log.isEnabledFor(logging.DEBUG)  # an inactive log costs no time

    def listen(self, listener: Listener) -> None:
        """Adds a listener. It gets `>` or `<`, and the bytes."""
        self._listeners.append(listener)
        self.active = True

    def sent(self, data: bytes) -> None:
        self._pass_on(">", data)

    def heard(self, data: bytes) -> None:
        self._pass_on("<", data)

    def _pass_on(self, direction: str, data: bytes) -> None:
        log.debug("%s %s %s", self.line, direction, data.hex(" "))
        for listener in self._listeners:
            listener(direction, data)
