"""Tag <-> key expression: where every value, write, description and status lies on Zenoh.

Chunks that begin with `@` are matched by no wildcard, so each family of keys below is asked for
by name:

    <prefix>/<device>/<tag>             the value
    <prefix>/<device>/<tag>/@set        write it
    <prefix>/<device>/<tag>/@meta       what it is
    <prefix>/<device>/@run              have it run; so @stop, @loopback, @model
    <prefix>/<device>/@block            all tags of the device that changed in one scan
    <prefix>/@gateway/<name>/…          state and statistics, the outcome of every write
    <prefix>/@standby/<group>/…         tokens of the gateways that stand in for one another
    …/@adv/**                           what a Zenoh AdvancedSubscriber asks late
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from gateway.errors import BadValue, ConfigError

_CHUNK = re.compile(r"[\w.\-]+\Z")
_DURATION = re.compile(r"([0-9]{1,9}(?:\.[0-9]{0,9})?)(ms|s|min|m|h|d|)\Z")
_SECONDS = {"ms": 0.001, "s": 1.0, "": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


class Family(StrEnum):
    """What is wanted of the tags a key names."""

    VALUE = "value"
    LAST = "last"  # the last value, as an AdvancedSubscriber asks for it
    SET = "set"
    META = "meta"
    BLOCK = "block"
    STATUS = "status"
    COMMAND = "command"


_BY_LAST_CHUNK = {"@set": Family.SET, "@meta": Family.META, "@block": Family.BLOCK}
_BY_LAST_CHUNK |= dict.fromkeys(("@run", "@stop", "@loopback", "@model"), Family.COMMAND)


class Asked(NamedTuple):
    """A key taken apart: `of` is the key expression of the values (or devices, or status) meant."""

    family: Family
    of: str

    @property
    def is_wild(self) -> bool:
        """More than one key may be meant."""
        return "*" in self.of


def asked(key: str) -> Asked:
    """What a key expression that arrived asks for."""
    stem, _, last = key.rpartition("/")
    if family := _BY_LAST_CHUNK.get(last):
        return Asked(family, stem)
    stem, late, _ = key.partition("/@adv")
    if late:
        return Asked(Family.LAST, stem)
    if "@gateway" in (chunks := key.split("/")):
        tells = chunks[-3:-2] == ["lines"] and chunks[-1] == "global"
        return Asked(Family.COMMAND if tells else Family.STATUS, key)
    return Asked(Family.VALUE, key)


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one gateway: `prefix` is one or more chunks, `gateway` is its name."""

    prefix: str
    gateway: str

    def __post_init__(self) -> None:
        for chunk in self.prefix.split("/"):
            _check(chunk, f"the prefix {self.prefix!r}")
        _check(self.gateway, f"the gateway's name {self.gateway!r}")

    @property
    def values(self) -> str:
        """Every value of every gateway under the prefix."""
        return f"{self.prefix}/**"

    @property
    def late(self) -> str:
        """What AdvancedSubscribers ask for when they come late."""
        return f"{self.prefix}/**/@adv/**"

    @property
    def metas(self) -> str:
        return f"{self.prefix}/**/@meta"

    @property
    def blocks(self) -> str:
        return f"{self.prefix}/*/@block"

    @property
    def own(self) -> str:
        """The liveliness token of the gateway; all that is its own lies below."""
        return f"{self.prefix}/@gateway/{self.gateway}"

    @property
    def statuses(self) -> str:
        return f"{self.own}/**"

    @property
    def writes(self) -> str:
        """Where the outcome of every write is published."""
        return f"{self.own}/writes"

    def group(self, group: str) -> str:
        """What gateways of one standby group show lies below."""
        return f"{self.prefix}/@standby/{group}"

    def sign(self, group: str, role: str, gateway: str, session: str) -> str:
        """The liveliness token of a role in a standby group."""
        return f"{self.group(group)}/{role}/{gateway}/{session}"

    def status(self, path: str) -> str:
        """`status`, `lines/<line>` or `devices/<device>` of this gateway."""
        return f"{self.own}/{path}"

    def device(self, device: str) -> str:
        """The liveliness token of a device; its values lie below."""
        return f"{self.prefix}/{device}"

    def value(self, tag: str) -> str:
        """The value's key; `tag` is `device/name`."""
        return f"{self.prefix}/{tag}"

    def tag(self, value_key: str) -> str | None:
        """`device/name` of a value's key, the inverse of `value`; None if it lies elsewhere."""
        stem = f"{self.prefix}/"
        return value_key[len(stem) :] if value_key.startswith(stem) else None

    def sets(self, device: str) -> str:
        """Every write to one device."""
        return f"{self.prefix}/{device}/**/@set"

    def set(self, tag: str) -> str:
        return f"{self.prefix}/{tag}/@set"

    def meta(self, tag: str) -> str:
        return f"{self.prefix}/{tag}/@meta"

    def command(self, device: str, command: str) -> str:
        """Have a device run, stop ..."""
        return f"{self.prefix}/{device}/@{command}"

    def to_all(self, line: str) -> str:
        """What every station of a line is told."""
        return f"{self.own}/lines/{line}/global"

    def block(self, device: str) -> str:
        return f"{self.prefix}/{device}/@block"


def max_age(text: str) -> float:
    """The seconds of `?max_age=500ms` (ms, s, min, h, d; s when no unit). Raises `BadValue`."""
    match = _DURATION.match(text)
    if match is None:
        raise BadValue(f"max_age={text[:40]} is no duration such as 0s, 500ms or 2min")
    return float(match[1]) * _SECONDS[match[2]]


def _check(chunk: str, what: str) -> None:
    if not _CHUNK.match(chunk):
        raise ConfigError(
            f"{what}: each part between slashes is letters, digits, '_', '-' and '.', "
            f"and {chunk!r} is not"
        )
