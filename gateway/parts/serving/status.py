"""The state of served lines and their stations, as documents like those of other lines."""

from collections.abc import Iterable
from math import isinf

from gateway.contract.status import Document, calls_document
from gateway.parts.serving.served_line import ServedLine
from gateway.stations.served.station import Station


def served_documents(lines: Iterable[ServedLine], now: float) -> dict[str, Document]:
    """Returns documents by path. `now` by the loop's clock."""
    found: dict[str, Document] = {}
    for line in lines:
        found[f"lines/{line.name}"] = _line(line, now)
        for station in line.stations.values():
            found[f"devices/{station.name}"] = _station(station, now)
    return found


def _station(station: Station, now: float) -> Document:
    """One station. The fields of polls are empty: it sends no request."""
    counts, driver = station.counts, station.driver
    return {
        "protocol": driver.protocol,
        "station": driver.station,
        "served": True,
        "standing": station.presence.value,
        "diagnosis": station.diagnosis(),
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


def _line(line: ServedLine, now: float) -> Document:
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
