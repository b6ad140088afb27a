"""An edge node: the payloads that it sends, in their sequence."""

import time
from collections.abc import Iterable, Iterator
from typing import Any

from gateway.bridges.documents import Known
from gateway.bridges.mqtt.sparkplug.messages import Payload
from gateway.bridges.mqtt.sparkplug.metrics import (
    BOOLEAN,
    INT64,
    add,
    fill,
    milliseconds,
    number_of,
)
from gateway.bridges.remote_plant import RemotePlant

REBIRTH = "Node Control/Rebirth"
MOST_METRICS = 5000  # in one message of data
Message = tuple[str, bytes]  # topic and payload


class EdgeNode:
    """Makes the messages of `spBv1.0/<group>/…/<node>`. Each begins a new number in the sequence.

    `born`: the devices with a birth and no death since. An alias belongs to a tag as long as this
    program runs.
    """

    def __init__(self, group: str, node: str, plant: RemotePlant) -> None:
        self.born: set[str] = set()
        self._group, self._node, self._plant = group, node, plant
        self._keys: dict[str, dict[str, None]] = {}  # by device
        self._aliases: dict[str, int] = {}  # by key
        self._tags: list[str] = []  # by alias, from 1
        self._bd_seq, self._seq = -1, 0

    def topic(self, kind: str, *device: str) -> str:
        return "/".join(["spBv1.0", self._group, kind, self._node, *device])

    def describe(self, key: str) -> None:
        """Takes a tag up, if it is new."""
        if key not in self._aliases:
            self._tags.append(key)
            self._aliases[key] = len(self._tags)  # not 0: programs take it for none
            self._keys.setdefault(key.partition("/")[0], {})[key] = None

    def key(self, device: str, metric: Any) -> str | None:
        """Returns the tag of a metric in a command to a device; None: it has no such tag."""
        if metric.HasField("name"):
            key = f"{device}/{metric.name}"
        else:
            key = self._tags[metric.alias - 1] if 0 < metric.alias <= len(self._tags) else ""
        return key if key in self._keys.get(device, ()) else None

    def connecting(self) -> Message:
        """Returns the death of the session that begins: the last will."""
        self._bd_seq = (self._bd_seq + 1) % 256
        self.born.clear()
        return self.death()

    def death(self) -> Message:
        payload = Payload(timestamp=_now())
        self._count(payload)
        return self.topic("NDEATH"), payload.SerializeToString()

    def birth(self) -> Message:
        """Begins the sequence; the births of the devices follow."""
        self.born.clear()
        self._seq = 0
        payload = Payload(timestamp=_now())
        self._count(payload)
        payload.metrics.add(
            name=REBIRTH, timestamp=payload.timestamp, datatype=BOOLEAN, boolean_value=False
        )
        return self._numbered(payload, "NBIRTH")

    def device_birth(self, device: str) -> Message:
        self.born.add(device)
        payload = Payload(timestamp=_now())
        for key, known in self._in_order(self._keys.get(device, ())):
            meta = self._plant.tags[key]
            metric = payload.metrics.add(
                name=key.partition("/")[2], alias=self._aliases[key], datatype=number_of(meta)
            )
            fill(metric, known, meta)
            for name, about in _properties(meta).items():
                add(metric, name, about)
        return self._numbered(payload, "DBIRTH", device)

    def device_death(self, device: str) -> Message:
        self.born.discard(device)
        return self._numbered(Payload(timestamp=_now()), "DDEATH", device)

    def data(self, changes: Iterable[tuple[str, Known]]) -> Iterator[Message]:
        """Yields messages with these changes of devices that are born."""
        by_device: dict[str, list[tuple[str, Known]]] = {}
        for key, known in changes:
            by_device.setdefault(key.partition("/")[0], []).append((key, known))
        for device in by_device.keys() & self.born:
            found = sorted(by_device[device], key=lambda change: milliseconds(change[1]))
            for first in range(0, len(found), MOST_METRICS):
                payload = Payload(timestamp=_now())
                for key, known in found[first : first + MOST_METRICS]:
                    metric = payload.metrics.add(alias=self._aliases[key])
                    fill(metric, known, self._plant.tags[key])
                yield self._numbered(payload, "DDATA", device)

    def _in_order(self, keys: Iterable[str]) -> list[tuple[str, Known]]:
        """An event (a bar code) is no value of now: it has none at a birth."""
        found = []
        for key in keys:
            known = self._plant.values[key]
            if self._plant.tags[key].get("event") and known["quality"] != "bad":
                known = known | {"value": None, "quality": "bad", "reason": "event"}
            found.append((key, known))
        return sorted(found, key=lambda one: milliseconds(one[1]))

    def _count(self, payload: Any) -> None:
        payload.metrics.add(
            name="bdSeq", timestamp=payload.timestamp, datatype=INT64, long_value=self._bd_seq
        )

    def _numbered(self, payload: Any, *kind: str) -> Message:
        payload.seq = self._seq
        self._seq = (self._seq + 1) % 256
        return self.topic(*kind), payload.SerializeToString()


def _properties(meta: Known) -> dict[str, str | float]:
    """Returns what a description has, under the names that Ignition has for it."""
    limits = meta["write"] or {}
    found = {
        "engUnit": meta["unit"],
        "documentation": meta["description"],
        "engLow": limits.get("min"),
        "engHigh": limits.get("max"),
    }
    known = {
        name: about if isinstance(about, str) else float(about)
        for name, about in found.items()
        if about is not None and about != ""
    }
    return known | {"readOnly": not meta["write"]}


def _now() -> int:
    return time.time_ns() // 1_000_000
