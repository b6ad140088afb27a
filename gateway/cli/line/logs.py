"""Configures the log."""

import logging
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from enum import StrEnum
from typing import Any

import structlog
from structlog.typing import Processor

from gateway.cli.line.repeats import Repeats
from gateway.cli.terminal import printable

log = structlog.get_logger("gateway.log")

LIMIT = 10_000  # entries that wait while the reader of stderr stalls: 2 to 4 MB
FLUSH_EVERY = 1.0  # seconds: repeated entries may be due
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

    def __init__(
        self, file: int, processors: Sequence[Processor] = (), repeats: Repeats | None = None
    ) -> None:
        """`processors` render the entries of other libraries. `repeats` is flushed regularly."""
        super().__init__()
        self.dropped = 0
        self._processors = processors
        self._repeats = repeats
        self._file = file
        self._reported = 0
        self._queue: queue.Queue[str | None] = queue.Queue(LIMIT)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        if isinstance(record.msg, _Rendered) or not self._processors:
            self.write(record.getMessage())
            return
        entry: Any = {"event": record.getMessage()}
        if not record.name.startswith("gateway."):  # a library
            entry["logger"] = record.name
        if record.exc_info:
            entry["exc_info"] = record.exc_info
        with suppress(structlog.DropEvent):
            for processor in self._processors:
                entry = processor(None, record.levelname.lower(), entry)
            self.write(str(entry))

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
        flushed = time.monotonic()
        while True:
            if self._repeats is not None and time.monotonic() - flushed >= FLUSH_EVERY:
                self._repeats.flush()
                flushed = time.monotonic()
            try:
                text = self._queue.get(timeout=FLUSH_EVERY)
            except queue.Empty:
                continue
            if text is None:
                return
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


def _without_control_characters(
    _logger: object, _method: str, event: MutableMapping[str, Any]
) -> MutableMapping[str, Any]:
    """Keys and values of the network may hold line feeds and control sequences."""
    for name, value in event.items():
        if isinstance(value, str):
            event[name] = printable(value)
    return event


class _Rendered(str):
    """A line of the log: what other libraries log is none yet."""

    __slots__ = ()


def set_up(form: LogFormat, level: LogLevel) -> Callable[[str], None]:
    """Logs to stderr: text for people, or one JSON document per line for programs.

    Also warnings of Python and of libraries; with JSON also crashes. Returns a function that writes
    lines for people between the log entries.
    """
    render = (
        structlog.processors.JSONRenderer(default=str)
        if form is LogFormat.JSON
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    repeats = None if level is LogLevel.DEBUG else Repeats()
    processors: list[Processor] = [
        *([] if repeats is None else [repeats]),
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        _without_control_characters,
        structlog.processors.format_exc_info,
        lambda logger, method, event: _Rendered(render(logger, method, event)),
    ]
    handler = QueuedHandler(sys.stderr.fileno(), processors, repeats)
    logging.basicConfig(handlers=[handler], level=getattr(logging, level.upper()))
    logging.captureWarnings(True)
    structlog.configure(
        processors=[structlog.stdlib.filter_by_level, *processors],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    if form is LogFormat.JSON:
        _log_crashes()
    return handler.write


def _log_crashes() -> None:
    """Python itself would print a trace of many lines."""

    def of_thread(crash: threading.ExceptHookArgs) -> None:
        if crash.exc_type is not SystemExit:
            log.critical("thread crashed", exc_info=crash.exc_value)

    def of_cleanup(crash: "sys.UnraisableHookArgs") -> None:
        log.error("cleanup failed", exc_info=crash.exc_value, of=repr(crash.object))

    sys.excepthook = lambda _kind, crash, _trace: log.critical("gateway crashed", exc_info=crash)
    threading.excepthook = of_thread
    sys.unraisablehook = of_cleanup
