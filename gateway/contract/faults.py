"""Finds what is wrong in the status documents of a gateway, as sentences for people."""

import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

from gateway.contract.line_faults import Fault, device_warnings, line_fault, stands_by

JUMP_SHOWN = 3600.0  # seconds
DAYS_LEFT = 30  # of a certificate
_KEPT_TO_TELL = 0.04  # days of history: an hour
DAYS_OF_DISK = 14  # left for history
ALARM_STATES = ("normal", "active", "acknowledged", "returned", "shelved", "out_of_service")
ROWS_SHOWN = 10  # numbers of transfers in one sentence
Document = Mapping[str, Any]
Documents = Mapping[str, Document]  # by path: `status`, `lines/hall-1`, `devices/mixer`


def faults(documents: Documents) -> Iterator[str]:
    """Yields what needs a person, as sentences."""
    return (one.text for one in coded_faults(documents))


def coded_faults(documents: Documents) -> Iterator[Fault]:
    """Yields what needs a person: lines that are down, silent devices, transfers that do not
    work, a lost router, a stopped part, history not written."""
    if not stands_by(documents):
        for line, document in sorted(below("lines/", documents), key=lambda one: one[1]["open"]):
            yield from line_fault(line, document, _devices_of(document, documents))
    unreachable = _unreachable(documents)
    for number, row in transfers(documents):
        if _fails(row) and not _waits_for(row, unreachable, documents):
            which = f"transfer {number} ({row['from']} to {row['to']})"
            yield Fault(
                "transfer", f"{which} is {row['state']}: {row['why']}", f"transfers/{number}"
            )
    zenoh = documents.get("zenoh", {})
    if (wanted := zenoh.get("connect")) and not {"router", "peer"} & set(zenoh["to"]):
        where = " or ".join(wanted)
        text = f"Zenoh: not connected to {where}: its clients get no values"
        yield Fault("no-router", text, "zenoh")
    yield from _of_parts(documents)
    for setting, document in below("certificates/", documents):
        called = setting if "." in setting else f"zenoh.tls.{setting}"
        if wrong := certificate_fault(called, document):
            yield Fault("certificate", wrong, f"certificates/{setting}")
    history = documents.get("history", {"state": "ok"})
    if history["state"] != "ok":
        yield Fault("history", f"history: {history['state']}", "history")
    if aside := history.get("aside"):
        what = f"{aside[0]} was moved aside: see `plc-gateway history salvage` and `known`"
        yield Fault("history", f"history: {what}", "history")


def _of_parts(documents: Documents) -> Iterator[Fault]:
    for part, document in below("parts/", documents):
        if document["why"]:
            again = f"it is tried again in {document['again']} s"
            text = f"{part} stopped: {document['why']}; {again}"
            yield Fault("part-stopped", text, f"parts/{part}")
        for one in document.get("faults", ()):
            yield Fault(one["code"], one["text"], f"parts/{part}")
    for door, document in below("doors/", documents):
        if document["trouble"]:
            which = f"door {door} to line {document['line']}"
            text = f"{which} is closed: {document['trouble']}"
            yield Fault("door-closed", text, f"doors/{door}")
    for way, document in below("notify/", documents):
        if document["trouble"]:
            wait = f"{document['waiting']} waiting since {document['oldest']}"
            text = f"{way} does not work: {document['trouble']}; messages about alarms: {wait}"
            yield Fault("notify", text, f"notify/{way}")
    for part, document in below("files/", documents):
        if document["trouble"]:
            effect = "a restart forgets the last changes"
            text = f"{part} not saved: {document['trouble']}; {effect}"
            yield Fault("not-saved", text, f"files/{part}")


def certificate_fault(setting: str, document: Document) -> str:
    """Returns what is wrong with a certificate, from its status document; empty: nothing."""
    file, days = document["file"], document["days"]
    if document["trouble"]:
        return f"{setting} {file}: {document['trouble']}"
    if days < 0:
        who = "Zenoh" if setting.startswith("zenoh") else "the other side"
        return f"{setting} {file} expired {-days:.0f} d ago: {who} accepts no new connection"
    if days < DAYS_LEFT:
        return f"{setting} {file} expires in {days:.0f} d: renew it"
    return ""


def warnings(documents: Documents) -> Iterator[str]:
    """Yields what is not as it should be, while other values are good, as sentences."""
    return (one.text for one in coded_warnings(documents))


def coded_warnings(documents: Documents) -> Iterator[Fault]:
    """Yields what is not as it should be, while other values are good."""
    unreachable = _unreachable(documents)
    for name, device in below("devices/", documents):
        for text in device["refused_addresses"]:
            yield Fault("addresses-refused", text, f"devices/{name}")
    for line, document in below("lines/", documents):
        yield from _of_line(line, document, documents, unreachable)
    yield from _of_others(documents["status"])
    yield from _of_group(documents.get("standby", {}))
    yield from _held_up(documents, unreachable)
    reload = documents.get("reload", {})
    if reload.get("refused"):
        more = f" and {len(reload['why']) - 1} more" if len(reload["why"]) > 1 else ""
        text = f"the changed file was refused at {reload['refused']}: {reload['why'][0]}{more}"
        yield Fault("file-refused", text, "reload")
    yield from _of_remote(documents.get("remote/file", {"state": "none"}))
    yield from _of_times(documents)
    yield from _of_history(documents)


def _of_line(
    line: str, document: Document, documents: Documents, unreachable: set[str]
) -> Iterator[Fault]:
    devices = _devices_of(document, documents)
    yield from device_warnings(line, [one for one in devices if one[0] not in unreachable])
    load, about = document["expected"]["load"], f"lines/{line}"
    if load > 1.0:
        text = f"line {line}: asked for {load:.1f} times what it carries: see `check`"
        yield Fault("overloaded", text, about)
    calls = document.get("calls") or {}
    if document["open"] and calls.get("in_a_row"):
        text = f"line {line}: the last call failed: {calls['last_failure']}"
        yield Fault("call-failed", text, about)


def _of_times(documents: Documents) -> Iterator[Fault]:
    clock = documents.get("clock", {})
    if (ago := clock.get("ago")) is not None and ago < JUMP_SHOWN:
        text = (
            f"the clock of this machine jumped by {clock['last']:+.1f} s {ago / 60:.0f} min ago: "
            "times before and after it do not belong together"
        )
        yield Fault("clock-jumped", text, "clock")
    alarms = documents.get("alarms", {})
    if since := alarms.get("flood_since"):
        text = (
            f"alarm flood since {since[:19]}Z: {alarms['raised_in_10_min']} alarms in 10 min, more "
            "than an operator reads: `plc-gateway alarms`"
        )
        yield Fault("alarm-flood", text, "alarms")


def _of_history(documents: Documents) -> Iterator[Fault]:
    if lost := documents.get("history", {}).get("lost"):
        yield Fault("samples-lost", f"history: samples lost since the start: {lost}", "history")
    if (days := disk_days(documents)) is not None and days < DAYS_OF_DISK:
        text = f"history: its disk is full in {days:.1f} days: make room, or a smaller `max_size`"
        yield Fault("disk-fills", text, "history")


def _of_remote(change: Document) -> Iterator[Fault]:
    if change["state"] == "waiting":
        by, until = change["by"], change["until"]
        text = f"the file of {by} waits for confirmation: it goes back at {until}"
        yield Fault("file-unconfirmed", text, "remote/file")
    elif change["state"] == "failed":
        text = f"the file of {change['by']} did not go back: {change['why']}"
        yield Fault("file-not-back", text, "remote/file")


def disk_days(documents: Documents) -> float | None:
    """Returns in how many days the disk of history is full, if it grows as it did. None: it is not
    known yet, or the file reaches its largest size before."""
    history = documents.get("history", {})
    free, oldest = history.get("free"), history.get("oldest")
    if free is None or oldest is None or free >= history["room"]:
        return None
    now = datetime.fromisoformat(documents["status"]["time"])
    kept = (now - datetime.fromisoformat(oldest)).total_seconds() / 86400
    return float(free / history["bytes"] * kept) if kept > _KEPT_TO_TELL else None


def _of_others(status: Document) -> Iterator[Fault]:
    """Yields what other programs on Zenoh do instead of this gateway, or beside it."""
    for device, other in status["refused_devices"].items():
        text = f"{device} is served by another gateway, {other}"
        yield Fault("served-elsewhere", text, f"devices/{device}")
    if key := status.get("answered_elsewhere"):
        text = (
            f"another program answers queries of {key}, such as a storage of Zenoh: its values may "
            "be old and look good"
        )
        yield Fault("answered-elsewhere", text, "status")


def _of_group(standby: Document) -> Iterator[Fault]:
    active = standby.get("stand") == "active"
    if active and not {*standby["others_waiting"], *standby["others_active"]}:
        group = standby["group"]
        text = f"no other gateway of group {group} waits: none takes over when this one fails"
        yield Fault("no-standby", text, "standby")


def causes(documents: Documents) -> dict[str, tuple[list[str], list[str]]]:
    """Returns faults and warnings of each line: a sentence for each cause."""
    unreachable, found = _unreachable(documents), {}
    for line, document in below("lines/", documents):
        devices = _devices_of(document, documents)
        wrong = () if stands_by(documents) else line_fault(line, document, devices)
        told = _of_line(line, document, documents, unreachable)
        found[line] = [one.text for one in wrong], [one.text for one in told]
    return found


def _devices_of(line: Document, documents: Documents) -> list[tuple[str, Document]]:
    found = [(name, documents.get(f"devices/{name}")) for name in line["devices"]]
    return [(name, document) for name, document in found if document is not None]


def _unreachable(documents: Documents) -> set[str]:
    """Returns the devices that are a fault by themselves, or by their line."""
    found = {
        device
        for _, document in below("lines/", documents)
        if not document["open"]
        for device in document["devices"]
    }
    devices = below("devices/", documents)
    return found | {name for name, document in devices if document["standing"] == "silent"}


def _fails(row: Document) -> bool:
    return row["state"] not in ("starting", "carried")


def _waits_for(row: Document, unreachable: set[str], documents: Documents) -> list[str]:
    """Returns the devices of a row that cannot be reached now, or are not polled at all."""
    names = [re.split("[/:]", row[end], maxsplit=1)[0] for end in ("from", "to")]
    return [one for one in names if one in unreachable or f"devices/{one}" not in documents]


def _held_up(documents: Documents, unreachable: set[str]) -> Iterator[Fault]:
    """Yields the transfers that wait for a device: their cause is among the faults already."""
    waiting: dict[str, list[str]] = {}
    for number, row in transfers(documents):
        if _fails(row) and (devices := _waits_for(row, unreachable, documents)):
            waiting.setdefault(devices[0], []).append(number)
    for device, numbers in sorted(waiting.items()):
        rows = f"transfer {numbers[0]} waits" if len(numbers) == 1 else _several(numbers)
        yield Fault("transfer-waits", f"{rows} for {device}", f"transfers/{numbers[0]}")


def _several(numbers: list[str]) -> str:
    shown = ", ".join(numbers[:ROWS_SHOWN])
    more = len(numbers) - ROWS_SHOWN
    return f"transfers {shown}{f' and {more} more' if more > 0 else ''} wait"


def transfers(documents: Documents) -> list[tuple[str, Document]]:
    """Returns the documents of the transfers by number, in this order."""
    return sorted(below("transfers/", documents), key=lambda row: int(row[0]))


def below(folder: str, documents: Documents) -> Iterator[tuple[str, Document]]:
    """Yields the documents of a folder by name."""
    for path, document in sorted(documents.items()):
        if path.startswith(folder):
            yield path.removeprefix(folder), document
