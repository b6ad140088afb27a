"""Parses arguments of the command line: tags, devices, wildcards, values."""

import json
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import zenoh

from gateway.config.messages import similar
from gateway.errors import ConfigError
from gateway.values import Value
from gateway.values.numerals import parse_decimal

if TYPE_CHECKING:
    from gateway.config import Config
    from gateway.config.gateway_address import GatewayAddress
    from gateway.tags import Tag


def tags_by_key(config: "Config | GatewayAddress") -> "dict[str, Tag]":
    """Returns all tags by `device/tag`."""
    return {tag.key: tag for device in config.devices for tag in device.tags}


def wanted_keys(config: "Config", names: list[str] | None) -> list[str]:
    """Returns key expressions for names of tags and devices and for wildcards.

    No names mean all tags. Raises `ConfigError` for a name that matches no tag.
    """
    if not names:
        return ["**"]
    known = tags_by_key(config)
    devices = {device.name for device in config.devices}
    wanted = []
    for name in names:
        key = f"{name}/**" if name in devices else name
        try:
            found = any(matches(tag, [key]) for tag in known)
        except zenoh.ZError:
            raise ConfigError(f"{key} is not a tag, and not a wildcard like 'mixer/**'") from None
        if not found:
            more = suggestion(name, [*known, *devices])
            raise ConfigError(f"there is no tag or device {key}{more}")
        wanted.append(key)
    return wanted


def suggestion(name: str, known: Iterable[str]) -> str:
    """Returns `: did you mean ...?` with the most similar name, or nothing."""
    close = similar(name, known)
    return f": did you mean {close}?" if close else ""


def matches(key: str, wanted: list[str]) -> bool:
    """Returns True when a key expression matches the key. Raises `ZError` for an invalid one."""
    return any(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)) for expression in wanted)


def parse_value(text: str) -> Value:
    """Parses JSON (`true`, `12.5`, `"AB"`, `[1, 2]`); any other text is a string."""
    try:
        value = json.loads(text, parse_float=parse_decimal)
    except ValueError:
        return text
    elements = value if isinstance(value, list) else [value]
    if not all(isinstance(one, (bool, int, float, str)) for one in elements):
        return text
    if any(isinstance(one, float) and not math.isfinite(one) for one in elements):
        return text  # NaN and 1e999 are not JSON
    return tuple(value) if isinstance(value, list) else value
