"""Finds what is wrong in the status documents of a gateway, as sentences for people."""

from collections.abc import Iterator, Mapping
from typing import Any

JUMP_SHOWN = 3600.0  # seconds
Documents = Mapping[str, Mapping[str, Any]]  # by path: `status`, `lines/hall-1`, `devices/mixer`


def faults(documents: Documents) -> Iterator[str]:
    """Yields what needs a person: lines that are down, silent devices, a lost router,
    history not written."""
    for line, document in below("lines/", documents):
        if not document["open"]:
            yield f"line {line} is down: {document['trouble'] or 'not opened yet'}"
    for device, document in below("devices/", documents):
        if document["standing"] == "silent":
            yield f"{device} is silent: {document['diagnosis']}"
    zenoh = documents.get("zenoh", {})
    if (wanted := zenoh.get("connect")) and not {"router", "peer"} & set(zenoh["to"]):
        yield f"Zenoh: not connected to {' or '.join(wanted)}: its clients get no values"
    history = documents.get("history", {"state": "ok"})
    if history["state"] != "ok":
        yield f"history: {history['state']}"


def warnings(documents: Documents) -> Iterator[str]:
    """Yields what is not as it should be, while other values are good."""
    down = {
        device
        for _, document in below("lines/", documents)
        if not document["open"]
        for device in document["devices"]
    }
    for device, document in below("devices/", documents):
        known = document["standing"] == "silent" or device in down
        if document["diagnosis"] and not known:
            yield f"{device}: {document['diagnosis']}"
        yield from document["refused_addresses"]
    for line, document in below("lines/", documents):
        load = document["expected"]["load"]
        if load > 1.0:
            yield f"line {line} is asked for {load:.1f} times what it carries: see `check`"
    for device, other in documents["status"]["refused_devices"].items():
        yield f"{device} is served by another gateway, {other}"
    yield from _transfers(documents)
    reload = documents.get("reload", {})
    if reload.get("refused"):
        more = f" and {len(reload['why']) - 1} more" if len(reload["why"]) > 1 else ""
        yield f"the changed file was refused at {reload['refused']}: {reload['why'][0]}{more}"
    clock = documents.get("clock", {})
    if (ago := clock.get("ago")) is not None and ago < JUMP_SHOWN:
        yield (
            f"the clock of this machine jumped by {clock['last']:+.1f} s {ago / 60:.0f} min ago: "
            "times before and after it do not belong together"
        )
    if lost := documents.get("history", {}).get("lost"):
        yield f"history: {lost} samples were lost since the start"


def _transfers(documents: Documents) -> Iterator[str]:
    for number, document in below("transfers/", documents):
        if document["state"] not in ("starting", "carried"):
            row = f"transfer {number} ({document['from']} to {document['to']})"
            yield f"{row} is {document['state']}: {document['why']}"


def below(folder: str, documents: Documents) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yields the documents of a folder by name."""
    for path, document in sorted(documents.items()):
        if path.startswith(folder):
            yield path.removeprefix(folder), document
