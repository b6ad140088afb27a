"""The served lines as a part."""

import asyncio
from collections.abc import Iterable, Mapping
from math import isinf

from gateway.contract.documents.state import DeviceDocument, LineDocument
from gateway.contract.status import Document, calls_document
from gateway.line.wire_log import WireLog
from gateway.parts.serving.served_line import ServedLine
from gateway.parts.serving.served_lines import ServedLines
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.plant.plant import Plant
from gateway.stations.served.station import ServedStation
from gateway.tags import Sample


class ServingPart:
    """The lines on which the gateway is a station of another master."""

    def __init__(self, plant: Plant) -> None:
        def sample_of(key: str) -> Sample | None:
            tag = plant.tag(key)
            return None if tag is None else plant.sample(tag)

        self._served = served = ServedLines(
            plant.config, plant, sample_of, wall=plant.wall, duty=plant.duty
        )
        self.holds, self.write_group = served.holds, served.write_group
        self.seen = served.remember
        self.lines = served.lines

    @property
    def wants(self) -> bool:
        return bool(self._served.remembering)

    async def begin(self) -> None:
        await self._served.restore()

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for line in self.lines:
                tasks.create_task(line.run(), name=line.name)

    def wire_logs(self) -> Mapping[str, WireLog]:
        return {line.name: line.wire_log for line in self.lines}

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return served_documents(self.lines, asyncio.get_running_loop().time())


def _make(core: Core) -> Part | None:
    return ServingPart(core.plant) if any(line.serve for line in core.config.lines) else None


KIND = Kind(_make, Phase.DRIVING)


def served_documents(lines: Iterable[ServedLine], now: float) -> dict[str, Document]:
    """Returns documents by path. `now` by the loop's clock."""
    found: dict[str, Document] = {}
    for line in lines:
        found[f"lines/{line.name}"] = _line(line, now)
        for station in line.stations.values():
            found[f"devices/{station.name}"] = _station(station, now)
    return found


def _station(station: ServedStation, now: float) -> DeviceDocument:
    """One station. The fields of polls are empty: it sends no request."""
    counts, driver, diagnosed = station.counts, station.driver, station.diagnosed()
    return {
        "protocol": driver.protocol,
        "station": driver.station,
        "served": True,
        "standing": station.presence.value,
        "diagnosis": diagnosed.text,
        "diagnosis_code": diagnosed.code,
        "identity": None,
        "exchanges": counts.requests,
        "writes": counts.writes,
        "slowest_write": 0.0,
        "wire_time": 0.0,
        "turnaround": None,
        "silence": 0.0,
        "late_replies": 0,
        "unasked_frames": 0,
        "frames_heard": counts.requests,
        "overruns": 0,
        "overdue": 0,
        "retries": 0,
        "last_good": None if counts.last is None else round(now - counts.last, 3),
        "stale_after": None if isinf(station.stale_after) else station.stale_after,
        "failures": {},
        "refusals": dict(counts.refusals),
        "refused_addresses": [],
        "requests": [],
    }


def _line(line: ServedLine, now: float) -> LineDocument:
    record = line.record
    open_for = 0.0 if line.opened is None else now - line.opened
    asked = sum(station.counts.requests for station in line.stations.values())
    return {
        "open": line.is_open,
        "served": True,
        "trouble": record.trouble,
        "last_trouble": record.trouble,
        "opened": record.opened,
        "open_for": round(open_for, 1),
        "open_time": round(open_for, 3),
        "baudrate": line.config.wire.baudrate,
        "devices": {one.name: one.presence.value for one in line.stations.values()},
        "busy_time": 0.0,
        "stale_requests": line.stale,
        "unsent_replies": line.unsent,
        "measured": {
            "load": None,
            "requests_per_second": round(asked / open_for, 3) if open_for else None,
            "slowest_write": 0.0,
        },
        "unasked_bytes": 0,
        "calls": None if record.calls is None else calls_document(record.calls, None, now),
        "expected": {"load": 0.0, "requests_per_second": 0.0, "cycle": 0.0, "worst_write": 0.0},
    }
