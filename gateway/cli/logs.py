"""Configures the log."""

import logging
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Callable, MutableMapping
from enum import StrEnum
from typing import Any

import structlog

from gateway.cli.terminal import printable
from gateway.northbound.rate_limit import RateLimit

log = structlog.get_logger("gateway.log")

LIMIT = 10_000  # entries that wait while the reader of stderr stalls: 2 to 4 MB
BURST = 20  # entries of one event and device at once
EVERY = 60.0  # seconds between further ones
_END_WITHIN = 0.2  # seconds for the last entries


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


class LogLevel(StrEnum):
    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class QueuedHandler(logging.Handler):
    """Writes entries on a thread of its own, so that a reader that stalls stops nothing else.

    Beyond `LIMIT` waiting entries the next are dropped and counted. The thread writes to the file
    itself: the lock of `sys.stderr` would hold up the end of the process.
    """

    def __init__(self, file: int) -> None:
        super().__init__()
        self.dropped = 0
        self._file = file
        self._reported = 0
        self._queue: queue.Queue[str | None] = queue.Queue(LIMIT)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        self.write(self.format(record))

    def write(self, text: str) -> None:
        """Queues lines. Never blocks."""
        try:
            self._queue.put_nowait(text)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Writes what waits, for a limited time."""
        try:
            self._queue.put_nowait(None)
            self._thread.join(_END_WITHIN)
        except queue.Full:
            pass  # the reader stalls
        super().close()

    def _run(self) -> None:
        while (text := self._queue.get()) is not None:
            try:
                self._write_all(f"{text}\n".encode(errors="backslashreplace"))
            except OSError:  # the reader has gone, or the disk is full
                self.dropped += 1
                continue  # a report would be dropped too
            if self.dropped > self._reported and self._queue.qsize() <= LIMIT // 2:
                count, self._reported = self.dropped - self._reported, self.dropped
                log.warning("log entries dropped", count=count)

    def _write_all(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self._file, data) :]
            except BlockingIOError:
                select.select((), (self._file,), ())


class Repeats:
    """Drops entries of one event and device that come too fast, and counts them in the next one.

    A bad line makes several entries a second: hundreds of megabytes a day for some devices.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._limits: dict[tuple[object, ...], RateLimit] = {}

    def __call__(
        self, _logger: object, _method: str, event: MutableMapping[str, Any]
    ) -> MutableMapping[str, Any]:
        source = event.get("line"), event.get("device")
        if source == (None, None):
            return event
        limit = self._limits.setdefault((event["event"], *source), RateLimit(BURST, EVERY))
        if not limit.allows(self._clock()):
            raise structlog.DropEvent
        if unlogged := limit.newly_suppressed():
            event["unlogged"] = unlogged
        return event


def _without_control_characters(
    _logger: object, _method: str, event: MutableMapping[str, Any]
) -> MutableMapping[str, Any]:
    """Keys and values of the network may hold line feeds and control sequences."""
    for name, value in event.items():
        if isinstance(value, str):
            event[name] = printable(value)
    return event


def set_up(form: LogFormat, level: LogLevel) -> Callable[[str], None]:
    """Logs to stderr: text for people, or one JSON document per line for programs.

    Returns a function that writes lines for people between the log entries.
    """
    handler = QueuedHandler(sys.stderr.fileno())
    logging.basicConfig(
        format="%(message)s", handlers=[handler], level=getattr(logging, level.upper())
    )
    render = (
        structlog.processors.JSONRenderer()
        if form is LogFormat.JSON
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            *([] if level is LogLevel.DEBUG else [Repeats()]),
            structlog.stdlib.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            _without_control_characters,
            structlog.processors.format_exc_info,
            render,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    return handler.write
