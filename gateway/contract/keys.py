"""Tag <-> key expression: the Zenoh keys of values, writes, descriptions and status.

No wildcard matches a chunk that begins with `@`, so each family of keys below is queried by name.
Zenoh compares each put with every declaration beside its key, level by level. So nothing is
declared for a single device, tag or command below `<prefix>/`: the wildcards below serve them all.

    <prefix>/<device>/<tag>             the value
    <prefix>/<device>/<tag>/@set        a write
    <prefix>/<device>/<tag>/@meta       its description
    <prefix>/<device>/@run              a command; also @stop, @loopback, @model
    <prefix>/<device>/@block            all tags of the device that changed in one scan
    <prefix>/@gateway/<name>/…          state and statistics, the outcome of every write
    <prefix>/@gateway/<name>/alarms/…   its alarms
    <prefix>/@gateway/<name>/audit/…    the records of its audit, by time
    <prefix>/@gateway/<name>/alive/…    liveliness tokens of its devices
    <prefix>/@gateway/<name>/lines/<line>/@trace    the exchanges of a line, while it is watched
    <prefix>/@gateway/<name>/@describe, @introspect    schemas; keys and rights
    <prefix>/@gateway/<name>/page     the last reply to a query with `page`
    <prefix>/@gateway/<name>/page/samples    samples of a page, many in one reply
    <prefix>/@gateway/<name>/claim/…    its claim to its devices: a document, and a token
    <prefix>/@standby/<group>/…         liveliness tokens of the gateways of a standby group
    …/@adv/**                           queries of a Zenoh AdvancedSubscriber that starts late
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from gateway.config.settings import parsers
from gateway.errors import BadValue, ConfigError
from gateway.values.numerals import nanoseconds

CONTRACT: Final = 1  # the number of the contract: docs/contract.md


class Family(StrEnum):
    """The kinds of keys."""

    VALUE = "value"
    LAST = "last"  # the last value, as an AdvancedSubscriber queries it
    SET = "set"
    META = "meta"
    BLOCK = "block"
    STATUS = "status"
    COMMAND = "command"
    PEEK = "peek"
    SELF = "self"  # what the gateway says of itself


_BY_LAST_CHUNK = {"@set": Family.SET, "@meta": Family.META, "@block": Family.BLOCK}
_BY_LAST_CHUNK["@peek"] = Family.PEEK
_BY_LAST_CHUNK |= dict.fromkeys(("@describe", "@introspect"), Family.SELF)
_BY_LAST_CHUNK |= dict.fromkeys(("@run", "@stop", "@loopback", "@model"), Family.COMMAND)


class ParsedKey(NamedTuple):
    """A received key; `target` is the key expression of its values, devices or status."""

    family: Family
    target: str

    @property
    def has_wildcard(self) -> bool:
        return "*" in self.target


def parse_key(key: str) -> ParsedKey:
    """Splits a received key expression into family and target."""
    stem, _, last = key.rpartition("/")
    if family := _BY_LAST_CHUNK.get(last):
        return ParsedKey(family, stem)
    stem, late, _ = key.partition("/@adv")
    if late:
        return ParsedKey(Family.LAST, stem)
    if "@gateway" in (chunks := key.split("/")):
        is_command = chunks[-3:-2] == ["lines"] and chunks[-1] == "global"
        return ParsedKey(Family.COMMAND if is_command else Family.STATUS, key)
    return ParsedKey(Family.VALUE, key)


def part_of(status_key: str) -> str:
    """Returns the name of the part in `…/@gateway/<name>/<part>/…`; empty: another status key."""
    chunks = status_key.partition("@gateway/")[2].split("/")
    return chunks[1] if len(chunks) > 2 else ""


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one gateway: `prefix` is one or more chunks, `gateway` is its name."""

    prefix: str
    gateway: str

    def __post_init__(self) -> None:
        _check(parsers.prefix, self.prefix, "the prefix")
        _check(parsers.name, self.gateway, "the gateway's name")

    @property
    def values(self) -> str:
        """Every value of every gateway under the prefix."""
        return f"{self.prefix}/**"

    @property
    def late(self) -> str:
        """Every key that an AdvancedSubscriber queries when it starts late."""
        return f"{self.prefix}/**/@adv/**"

    @property
    def own(self) -> str:
        """The liveliness token of the gateway; its status and writes lie below."""
        return f"{self.prefix}/@gateway/{self.gateway}"

    def everywhere(self, path: str) -> str:
        """A document of all gateways under the prefix, and under prefixes below it."""
        return f"{self.prefix}/**/@gateway/*/{path}"

    @property
    def describe(self) -> str:
        """The JSON Schema of every document. No wildcard matches it, nor the next one."""
        return f"{self.own}/@describe"

    @property
    def introspect(self) -> str:
        """The key of the keys, verbs and devices that this gateway serves."""
        return f"{self.own}/@introspect"

    @property
    def writes(self) -> str:
        """The outcome of every write."""
        return f"{self.own}/writes"

    def group(self, group: str) -> str:
        """The liveliness tokens of one standby group lie below."""
        return f"{self.prefix}/@standby/{group}"

    @property
    def claims(self) -> str:
        """The claims of all gateways under the prefix."""
        return f"{self.prefix}/@gateway/*/claim/*"

    def claim(self, session: str) -> str:
        """The claim of this gateway: a token, and a document with its devices."""
        return f"{self.own}/claim/{session}"

    def status(self, path: str) -> str:
        """`status`, `lines/<line>` or `devices/<device>` of this gateway; `**`: all of them."""
        return f"{self.own}/{path}"

    def device(self, device: str) -> str:
        """The values of a device lie below."""
        return f"{self.prefix}/{device}"

    def alive(self, device: str) -> str:
        """The liveliness token of a device."""
        return f"{self.own}/alive/{device}"

    def value(self, tag: str) -> str:
        """The value's key; `tag` is `device/name`."""
        return f"{self.prefix}/{tag}"

    def tag(self, value_key: str) -> str | None:
        """`device/name` of a value's key, the inverse of `value`; None if it lies elsewhere."""
        stem = f"{self.prefix}/"
        return value_key[len(stem) :] if value_key.startswith(stem) else None

    def set(self, tag: str) -> str:
        """The writes to a tag, or to a device; `**`: all under the prefix."""
        return f"{self.prefix}/{tag}/@set"

    def meta(self, tag: str) -> str:
        return f"{self.prefix}/{tag}/@meta"

    def command(self, device: str, command: str) -> str:
        """A command to one device: run, stop, peek ...; `*`: to all under the prefix."""
        return f"{self.prefix}/{device}/@{command}"

    def to_all(self, line: str) -> str:
        """A command to every station of a line."""
        return f"{self.own}/lines/{line}/global"

    def trace(self, line: str) -> str:
        """The exchanges of a line. No wildcard matches it: a client of all status keys must not
        start the traces of all lines."""
        return f"{self.own}/lines/{line}/@trace"

    def block(self, device: str) -> str:
        return f"{self.prefix}/{device}/@block"


def max_age(text: str) -> float:
    """The seconds of `?max_age=500ms`, or of a number of seconds. Raises `BadValue`."""
    time = nanoseconds(f"{text}s" if text[-1:].isdigit() else text)
    if time is None:
        raise BadValue(f"max_age={text[:40]} is no duration such as 0s, 500ms or 2min")
    return time / 10**9


def _check(parse: Callable[[object], str], text: str, what: str) -> None:
    """The rule of the configuration file, so that `check` and `run` never differ."""
    try:
        parse(text)
    except ConfigError as error:
        raise ConfigError(f"{what} {error}") from None
