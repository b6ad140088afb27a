"""The state of lines and devices as documents, for status keys and the status page."""

import math
from collections.abc import Mapping, Sequence

from gateway.contract.documents.state import (
    BlockReads,
    CallsDocument,
    DeviceDocument,
    IdentityDocument,
    LineDocument,
)
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.identity import Identity
from gateway.engine.device.records import CallRecord, CallState
from gateway.engine.dial_schedule import DialSchedule
from gateway.engine.engine import Engine
from gateway.engine.forecast import LineForecast
from gateway.engine.jobs.poll_entry import PolledBlock
from gateway.planning.bad_addresses import BadRange
from gateway.planning.planner import describe
from gateway.tags.timestamps import rfc3339

MOST_REQUESTS = 200
MOST_TOLD = 10  # texts of one name
BACK = 5.0  # seconds that a device of a silent line replies before that line is no longer silent
# The words of the status documents; users read them since the first version.
_STANDING = {State.ONLINE: "up", State.OFFLINE: "silent"}
Document = Mapping[str, object]


def standing(device: Device) -> str:
    """starting, up, failing or silent."""
    state = device.health.state
    return _STANDING.get(state, state.value)


def is_silent(engine: Engine, now: float) -> bool | None:
    """True if no device of an open line replies, or has replied for `BACK`: that is one cause, the
    line's. None: it is not known. A line with one device is never silent: its device is."""
    asked = [device for device in engine.devices if device.health.is_probed]
    back = [one for one in asked if one.health.online and now - one.record.falls.ended < BACK]
    if len(asked) < 2 or any(one.health.state is State.ONLINE and one not in back for one in asked):
        return False
    offline = sum(one.health.state is State.OFFLINE for one in asked)
    return True if offline and offline + len(back) == len(asked) else None


def device_document(device: Device, polls: Sequence[PolledBlock], now: float) -> DeviceDocument:
    """One device. Times in seconds, counts since the start. `now` by the loop's clock."""
    record, turnaround = device.record, device.record.replies.turnaround
    diagnosed = device.diagnosed()
    read = [at for poll in polls if (at := poll.reads.at) is not None]
    last_good = max(read, default=record.recent.good)
    return {
        "protocol": device.driver.protocol,
        "station": device.driver.station,
        "standing": standing(device),
        "diagnosis": diagnosed.text,
        "diagnosis_code": diagnosed.code,
        "identity": None if device.identity is None else _identity(device.identity),
        "silent_for": record.falls.lasts(now) if device.health.state is State.OFFLINE else None,
        "silences": record.falls.last_day(now),
        "lately": {"requests": len(record.recent.ends), "failed": dict(record.recent.failed())},
        "exchanges": record.exchanges,
        "writes": record.writes,
        "slowest_write": round(record.slowest_write, 4),
        "wire_time": round(record.wire_time, 3),
        "turnaround": None if turnaround is None else round(turnaround, 4),
        "silence": round(device.silence.shorter, 5),
        "late_replies": record.late,
        "unasked_frames": record.unasked,
        "frames_heard": record.heard,
        "overruns": record.overruns,
        "overdue": record.overdue,
        "retries": record.retries,
        "last_good": None if last_good is None else round(now - last_good, 3),
        "failures": dict(record.failures),
        "refusals": dict(record.refusals),
        "refused_addresses": [
            refused_sentence(device, bad) for bad in device.bad_addresses.bad.values()
        ],
        "requests": [_request(poll) for poll in polls[:MOST_REQUESTS]],
    }


def _identity(identity: Identity) -> IdentityDocument:
    told = {name: list(texts[:MOST_TOLD]) for name, texts in identity.told.items()}
    return {"verdict": identity.verdict, "wanted": dict(identity.wanted), "told": told}


def _request(poll: PolledBlock) -> BlockReads:
    """One block: its configured interval and the measured one."""
    record = poll.reads
    return {
        "tags": describe(poll.block),
        "every": poll.block.every,
        "measured_every": round(record.mean_gap, 4) if record.mean_gap else None,
        "worst_age": round(record.worst_gap, 4) if record.worst_gap else None,
        "reads": record.count,
        "overruns": record.overruns,
    }


def refused_sentence(device: Device, bad: BadRange) -> str:
    """`D512..D519 of mixer: refused with 28 since 2026-11-20T12:00:00.000000Z`."""
    first, last = bad.tags[0].text, bad.tags[-1].text
    where = first if first == last else f"{first}..{last}"
    return f"{where} of {device.name}: {bad.how} since {rfc3339(bad.since)}"


def line_document(
    engine: Engine, expected: LineForecast, calls: DialSchedule | None, now: float
) -> LineDocument:
    """One line: the forecast and the measured figures. `now` by the loop's clock."""
    record = engine.record
    open_for = now - record.since if engine.is_open else 0.0
    busy = record.busy + record.turnarounds
    slowest = max((device.record.slowest_write for device in engine.devices), default=0.0)
    open_in_all = record.open_before + open_for
    exchanges = sum(device.record.exchanges for device in engine.devices)
    return {
        "open": engine.is_open,
        "trouble": record.trouble,
        "silent": is_silent(engine, now) is True,
        "last_trouble": record.last_trouble,
        "opened": record.opened,
        "open_for": round(open_for, 1),
        "down_for": record.falls.lasts(now),
        "losses": record.falls.last_day(now),
        "open_time": round(open_in_all, 3),
        "baudrate": engine.wire.baudrate,
        "devices": {device.name: standing(device) for device in engine.devices},
        "busy_time": round(busy, 3),
        "measured": {
            "load": round(busy / open_in_all, 4) if open_in_all else None,
            "requests_per_second": round(exchanges / open_in_all, 3) if open_in_all else None,
            "slowest_write": round(slowest, 4),
        },
        "unasked_bytes": record.unasked,
        "doubtful": any(device.is_doubtful for device in engine.devices),
        "expected": {
            "load": round(expected.load, 4),
            "load_proven": round(expected.load_proven, 4),
            "requests_per_second": round(expected.requests, 3),
            "cycle": round(expected.cycle, 4),
            "worst_write": round(expected.worst_write, 4),
        },
        "calls": None if record.calls is None else calls_document(record.calls, calls, now),
    }


def calls_document(record: CallRecord, calls: DialSchedule | None, now: float) -> CallsDocument:
    """The telephone calls of a line. `calls`: of a modem that dials, and is there."""
    waits = calls is not None and record.state is CallState.IDLE
    dials_at = calls.due(now) if calls is not None and waits else math.inf
    return {
        "state": record.state,
        "since": None if record.since is None else round(now - record.since, 1),
        "next": round(max(0.0, dials_at - now), 1) if dials_at < math.inf else None,
        "connected": record.state is CallState.CONNECTED,
        "made": record.made,
        "failed": record.failed,
        "in_a_row": 0 if calls is None else calls.failed,
        "last_result": record.last_result,
        "last_failure": record.last_failure,
        "results": dict(record.results),
    }
