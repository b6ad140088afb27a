"""The served lines of a gateway, and the values that clients write for their masters."""

import asyncio
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import structlog

from gateway.config import Config
from gateway.errors import BadValue, Busy
from gateway.line.send_permit import SendPermit
from gateway.parts.serving.served_line import ServedLine, ServedSink
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.stations.served.registers import Registers, ServedTag
from gateway.stations.served.station import ServedStation
from gateway.tags import Sample, Tag, WriteResult, good
from gateway.values import Value

log = structlog.get_logger("gateway")


class ServedLines:
    """All served lines, and the held values."""

    def __init__(
        self,
        config: Config,
        sink: ServedSink,
        sample_of: Callable[[str], Sample | None],
        *,
        wall: Callable[[], int] = time.time_ns,
        duty: SendPermit | None = None,
    ) -> None:
        """`sample_of`: the present sample of a tag by `device/tag`. `wall`: ns since 1970."""

        def sample(row: ServedTag) -> Sample | None:
            return sample_of(row.source or row.tag.key)

        self.lines = [
            ServedLine(line, sink, sample, wall=wall, duty=duty)
            for line in config.lines
            if line.serve and any(device.enabled for device in line.devices)
        ]
        self._sink = sink
        self._wall = wall
        self._file = None if config.held_file is None else SavedFile(config.held_file)
        self._saving = asyncio.Lock()
        self._rows = {row.tag: row for one in self.stations for row in one.registers.served.rows}
        self._retained: dict[Tag, Value] = {}
        # By source or own tag: the stations that answer with its last good value.
        self.remembering: dict[str, list[tuple[Registers, ServedTag]]] = {}
        for station in self.stations:
            for row in station.registers.served.rows:
                if row.hold_last and not row.accepted:
                    kept = self.remembering.setdefault(row.source or row.tag.key, [])
                    kept.append((station.registers, row))

    @property
    def stations(self) -> Sequence[ServedStation]:
        return [station for line in self.lines for station in line.stations.values()]

    def remember(self, samples: Sequence[Sample]) -> None:
        """Keeps the good samples of the sources with `hold_last`."""
        for sample in samples:
            for registers, row in self.remembering.get(sample.tag.key, ()):
                registers.remember(row, sample)

    # Held values

    def holds(self, tag: Tag) -> bool:
        """True for a value that clients write and a master reads."""
        return tag in self._rows

    async def write_group(self, values: Sequence[tuple[Tag, Value]]) -> list[WriteResult]:
        """Holds values for the master, all at once. Returns when they are kept.

        Raises `BadValue` and `Busy` before anything changed.
        """
        loop = asyncio.get_running_loop()
        started, held = loop.time(), dict[Tag, Value]()
        for tag, value in values:
            if tag.write is None:
                raise BadValue(f"{tag.key} is written by the master")
            real = tag.from_units(tag.encode(value))
            if real is None:
                raise BadValue(f"{value!r} cannot be read back after the write")
            held[tag] = real
        async with self._saving:  # writes keep their order
            retained = {tag: real for tag, real in held.items() if self._rows[tag].retain}
            if retained and self._file is not None:
                changed = self._retained | retained
                await asyncio.to_thread(self._file.save, to_text(changed))
                if self._file.trouble is not None:
                    raise Busy(f"it cannot be kept: {self._file.trouble}; not done")
                self._retained = changed
            at = self._wall()
            self._sink.samples([good(tag, real, at) for tag, real in held.items()])
        took = loop.time() - started
        return [
            WriteResult(
                real,
                at,
                took,
                verified=tag.write is not None and tag.write.verify,
                origin=tag.origin.word,
            )
            for tag, real in held.items()
        ]

    async def restore(self) -> None:
        """Publishes the held values of before the start."""
        if self._file is None:
            return
        parse = parser([tag for tag, row in self._rows.items() if row.retain])
        # Not orjson: it turns integers beyond 64 bits into floats.
        found = await off_loop(self._file.load, parse, json.loads)
        for tag, value in (found or {}).items():
            try:
                real = tag.from_units(tag.encode(value))
            except BadValue as error:
                log.warning("held value dropped", tag=tag.key, why=str(error))
                continue
            if real is not None:
                self._retained[tag] = real
        at = self._wall()
        self._sink.samples([good(tag, value, at) for tag, value in self._retained.items()])


FORMAT = 1
_SCALARS = (bool, int, float, str)


def to_text(values: Mapping[Tag, Value]) -> bytes:
    """Returns the content of the file."""
    held = {tag.key: value for tag, value in values.items()}
    return json.dumps({"form": FORMAT, "held": held}, indent=2).encode()


def parser(tags: Iterable[Tag]) -> Callable[[Any], dict[Tag, Value]]:
    """Returns the parser of the file: it finds the values of the tags that still exist."""

    def parse(document: Any) -> dict[Tag, Value]:
        if document["form"] != FORMAT:
            raise ValueError("no file of held values")
        held = document["held"]
        known = {tag: _value(held[tag.key]) for tag in tags if tag.key in held}
        return {tag: value for tag, value in known.items() if value is not None}

    return parse


def _value(value: object) -> Value | None:
    if isinstance(value, list) and all(isinstance(one, _SCALARS) for one in value):
        return tuple(value)
    return value if isinstance(value, _SCALARS) else None
