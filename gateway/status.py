"""The state of lines and devices as documents: what status keys, status page and people read."""

from collections.abc import Mapping

from gateway.device import Device
from gateway.forecast import LineForecast
from gateway.line import Line
from gateway.refusals import BadRange

Document = Mapping[str, object]


def device_document(device: Device, protocol: str) -> Document:
    """One device. Times in seconds, counts since the start."""
    record = device.record
    return {
        "protocol": protocol,
        "station": device.driver.station,
        "standing": device.standing.value,
        "diagnosis": device.diagnosis(),
        "exchanges": record.exchanges,
        "writes": record.writes,
        "slowest_write": round(record.slowest_write, 4),
        "wire_time": round(record.wire_time, 3),
        "turnaround": None if record.turnaround is None else round(record.turnaround, 4),
        "late_replies": record.late,
        "unasked_frames": record.unasked,
        "overruns": record.overruns,
        "failures": dict(record.failures),
        "refusals": dict(record.refusals),
        "refused_addresses": [
            refused_sentence(device, bad) for bad in device.refusals.bad.values()
        ],
    }


def refused_sentence(device: Device, bad: BadRange) -> str:
    """`D512..D519: refused with 28`."""
    first, last = bad.tags[0].text, bad.tags[-1].text
    where = first if first == last else f"{first}..{last}"
    return f"{where} of {device.name}: refused with {bad.code}"


def line_document(line: Line, expected: LineForecast, now: float) -> Document:
    """One line: what was promised and what was measured. `now` by the loop's clock."""
    record = line.record
    open_for = now - record.since if line.is_open else 0.0
    busy = record.busy + record.turnarounds
    return {
        "open": line.is_open,
        "trouble": record.trouble,
        "opened": record.opened,
        "open_for": round(open_for, 1),
        "baudrate": line.wire.baudrate,
        "devices": {device.name: device.standing.value for device in line.devices},
        "busy_time": round(busy, 3),
        "unasked_bytes": record.unasked,
        "expected": {
            "load": round(expected.load, 4),
            "requests_per_second": round(expected.requests, 3),
            "cycle": round(expected.cycle, 4),
            "worst_write": round(expected.worst_write, 4),
        },
    }
