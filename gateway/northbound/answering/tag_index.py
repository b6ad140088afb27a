"""The tags and devices that a key expression selects."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import zenoh

from gateway.contract.interfaces import Device
from gateway.contract.keys import Keys
from gateway.tags import Tag


class _Entry(NamedTuple):
    """The tags of one device, under `area`: `<prefix>/<device>/**`."""

    device: Device
    area: zenoh.KeyExpr


class TagIndex:
    """The plant's table for concrete keys, and one entry per device for wildcards. Read by many
    threads."""

    def __init__(
        self, keys: Keys, devices: Iterable[Device], find: Callable[[str], Tag | None]
    ) -> None:
        """`find`: returns the tag of `device/name`."""
        self.keys = keys
        self._find = find
        self._entries = [
            _Entry(device, zenoh.KeyExpr(f"{keys.device(device.name)}/**")) for device in devices
        ]
        self.tags: Sequence[Tag] = [tag for entry in self._entries for tag in entry.device.tags]
        modes = {entry.device.name: entry.device.blocks for entry in self._entries}
        self.names = frozenset(modes)
        self.with_blocks = frozenset(name for name, mode in modes.items() if mode)
        self.only_blocks = frozenset(name for name, mode in modes.items() if mode == "only")
        with_events = frozenset(tag.device for tag in self.tags if tag.publishing.event)
        self.sorted_out = self.with_blocks | with_events  # each value of the others is one put

    def become(self, other: "TagIndex") -> None:
        """Takes over the devices of another index. Each look-up sees the old or the new ones."""
        vars(self).update(vars(other))

    def tag_at(self, value_key: str) -> Tag | None:
        key = self.keys.tag(value_key)
        return None if key is None else self._find(key)

    def is_device(self, key: str) -> bool:
        """True for the key of one of our devices: no tag, no wildcard."""
        return self.keys.tag(key) in self.names

    def owns(self, key: str) -> bool:
        """True if `key` lies under one of our devices or under our status keys.

        Other gateways may share the prefix.
        """
        device = (self.keys.tag(key) or "").partition("/")[0]
        return device in self.names or key.startswith(f"{self.keys.own}/")

    def tags_at(self, expression: str) -> list[Tag]:
        """Returns the tags whose value keys intersect `expression`."""
        if "*" not in expression:
            tag = self.tag_at(expression)
            return [] if tag is None else [tag]
        selector = zenoh.KeyExpr(expression)
        found: list[Tag] = []
        for entry in self._entries:
            if selector.includes(entry.area):
                found.extend(entry.device.tags)
            elif selector.intersects(entry.area):
                tags, value = entry.device.tags, self.keys.value
                found.extend(tag for tag in tags if selector.intersects(value(tag.key)))
        return found

    def devices_at(self, expression: str) -> list[Device]:
        """Returns the devices whose own key, `<prefix>/<device>`, intersects `expression`."""
        selector = zenoh.KeyExpr(expression)
        return [
            entry.device
            for entry in self._entries
            if selector.intersects(self.keys.device(entry.device.name))
        ]
