"""Faults of lines and devices as sentences: one cause on one line is one sentence."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

NAMES_SHOWN = 5
# Words of `failures` in the documents of devices.
_KINDS = {
    "silence": "no reply",
    "noise": "no frame",
    "checksum": "a wrong check sum",
    "station": "the reply of another station",
    "shape": "the reply to another request",
    "truncated": "half a frame",
    "echo": "an echo only",
    "slow": "a late reply",
    "refusal": "a refusal of another request",
}
Document = Mapping[str, Any]
Named = tuple[str, Document]


class Fault(NamedTuple):
    """A fault or a warning. Programs count by `code`, people read `text`.

    `about`: the path of the status document that has its figures, such as `devices/mixer`.
    """

    code: str
    text: str
    about: str = ""


def stands_by(documents: Mapping[str, Document]) -> bool:
    """The gateway is a healthy standby: another one has its lines open."""
    stand: str = documents.get("standby", {}).get("stand", "active")
    return stand != "active"


def line_fault(line: str, document: Document, devices: Sequence[Named]) -> Iterator[Fault]:
    """Yields the fault of a line, or those of its devices, which `devices` has by name."""
    if not document["open"]:
        why = document["trouble"] or "not opened yet"
        past = _past(document, "down_for", "losses")
        yield Fault("line-down", f"line {line} is down: {why}{past}", f"lines/{line}")
        return
    for name, one in devices:
        if is_another(one):
            yield Fault("wrong-device", f"{name}: {one['diagnosis']}", f"devices/{name}")
    silent = [(name, one) for name, one in devices if one["standing"] == "silent"]
    for alike in _alike(silent):
        name, first = alike[0]
        past = _past(first, "silent_for", "silences")
        if len(alike) == 1:
            text = f"{name} is silent: {first['diagnosis']}{past}"
            yield Fault("device-silent", text, f"devices/{name}")
        else:
            number = f"all {len(alike)}" if len(alike) == len(devices) else str(len(alike))
            of_all = "" if len(alike) == len(devices) else f" of {len(devices)}"
            yield Fault(
                "device-silent",
                f"line {line}: {number}{of_all} devices are silent{_share(alike)}: "
                f"{first['diagnosis']}{past}: {_names(alike)}",
                f"lines/{line}",
            )


def is_another(device: Document) -> bool:
    """Returns True if the device that replies is not the one of the file."""
    return (device.get("identity") or {}).get("verdict") == "wrong"


def device_warnings(line: str, devices: Sequence[Named]) -> Iterator[Fault]:
    """Yields the diagnoses of devices that reply. An older gateway gives them no code."""
    told = [(name, one) for name, one in devices if one["diagnosis"] and not is_another(one)]
    for alike in _alike(told):
        name, first = alike[0]
        code, why = first.get("diagnosis_code", "other"), first["diagnosis"]
        if len(alike) == 1:
            yield Fault(code, f"{name}: {why}", f"devices/{name}")
        else:
            which = f"line {line}, {len(alike)} devices{_share(alike)}"
            yield Fault(code, f"{which}: {why}: {_names(alike)}", f"lines/{line}")


def span(seconds: float) -> str:
    """Returns `12 s`, `5 min`, `3 h 20 min` or `4 d 2 h`."""
    minutes, hours, days = int(seconds // 60), int(seconds // 3600), int(seconds // 86400)
    if days:
        return f"{days} d {hours % 24} h"
    if hours:
        return f"{hours} h {minutes % 60} min"
    return f"{minutes} min" if minutes else f"{seconds:.0f} s"


def _alike(devices: Sequence[Named]) -> list[list[Named]]:
    """Groups devices by their most frequent failure; without one by their diagnosis."""
    groups: dict[str, list[Named]] = {}
    for name, one in devices:
        groups.setdefault(_cause(one) or one["diagnosis"], []).append((name, one))
    return list(groups.values())


def _cause(device: Document) -> str:
    failed = Counter(device.get("lately", {}).get("failed", {}))
    return failed.most_common(1)[0][0] if failed else ""


def _share(alike: Sequence[Named]) -> str:
    cause = _cause(alike[0][1])
    if cause not in _KINDS:
        return ""
    lately = [one["lately"] for _, one in alike]
    requests = sum(one["requests"] for one in lately)
    failed = sum(one["failed"].get(cause, 0) for one in lately)
    return f", {_KINDS[cause]} to {failed / requests:.0%} of the last {requests} requests"


def _names(alike: Sequence[Named]) -> str:
    more = len(alike) - NAMES_SHOWN
    shown = ", ".join(name for name, _ in alike[:NAMES_SHOWN])
    return f"{shown}{f' and {more} more' if more > 0 else ''}"


def _past(document: Document, lasts: str, falls: str) -> str:
    """Returns the time that it has lasted, and how often it happened in 24 hours."""
    seconds, times = document.get(lasts), document.get(falls, 0)
    if seconds is None:
        return ""
    return f" (for {span(seconds)}{f', {times} times in 24 h' if times > 1 else ''})"
