"""Which tags and devices a key expression means."""

from collections.abc import Iterable
from typing import NamedTuple

import zenoh

from gateway.northbound.keys import Keys
from gateway.northbound.plant import Device
from gateway.tags import Tag


class _Shelf(NamedTuple):
    """The tags of one device, under `area`: `<prefix>/<device>/**`."""

    device: Device
    area: zenoh.KeyExpr
    tags: tuple[tuple[str, Tag], ...]  # with their value keys


class Directory:
    """A dict for concrete keys, and one shelf per device for wildcards. Read by many threads."""

    def __init__(self, keys: Keys, devices: Iterable[Device]) -> None:
        self._keys = keys
        self._shelves = [
            _Shelf(
                device,
                zenoh.KeyExpr(f"{keys.device(device.name)}/**"),
                tuple((keys.value(tag.key), tag) for tag in device.tags),
            )
            for device in devices
        ]
        self._names = {shelf.device.name for shelf in self._shelves}
        self._by_key = {key: tag for shelf in self._shelves for key, tag in shelf.tags}

    @property
    def devices(self) -> list[Device]:
        return [shelf.device for shelf in self._shelves]

    def all(self) -> list[Tag]:
        return list(self._by_key.values())

    def one(self, value_key: str) -> Tag | None:
        return self._by_key.get(value_key)

    def owns(self, key: str) -> bool:
        """Whether `key` lies under one of our devices: others may share the prefix."""
        device = (self._keys.tag(key) or "").partition("/")[0]
        return device in self._names

    def find(self, expression: str) -> list[Tag]:
        """The tags whose value keys `expression` meets."""
        if "*" not in expression:
            tag = self._by_key.get(expression)
            return [] if tag is None else [tag]
        wanted = zenoh.KeyExpr(expression)
        found: list[Tag] = []
        for shelf in self._shelves:
            if wanted.includes(shelf.area):
                found.extend(tag for _, tag in shelf.tags)
            elif wanted.intersects(shelf.area):
                found.extend(tag for key, tag in shelf.tags if wanted.intersects(key))
        return found

    def devices_under(self, expression: str) -> list[Device]:
        """The devices whose own key, `<prefix>/<device>`, `expression` meets."""
        wanted = zenoh.KeyExpr(expression)
        return [
            shelf.device
            for shelf in self._shelves
            if wanted.intersects(self._keys.device(shelf.device.name))
        ]
