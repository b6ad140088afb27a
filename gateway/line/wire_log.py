"""The wire log: every byte on a line with its time, for the log, for traces and for tests.

A line of it reads `12.345678 > 02 30 30 ...` (sent) or `<` (heard); times are seconds of the
loop's clock.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

log = logging.getLogger("gateway.wire")
Listener = Callable[[str, bytes], None]


@dataclass(slots=True, eq=False)
class Recorder:
    """Tells whoever listens what passes on one line. Costs nothing while nobody does."""

    line: str
    listeners: list[Listener] = field(default_factory=list)

    def sent(self, data: bytes) -> None:
        if self.listeners or log.isEnabledFor(logging.DEBUG):
            self._tell(">", data)

    def heard(self, data: bytes) -> None:
        if self.listeners or log.isEnabledFor(logging.DEBUG):
            self._tell("<", data)

    def _tell(self, way: str, data: bytes) -> None:
        log.debug("%s %s %s", self.line, way, data.hex(" "))
        for listener in self.listeners:
            listener(way, data)
