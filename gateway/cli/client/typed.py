"""What is typed in a shell: tags, devices, wildcards, values."""

import json
import math

import zenoh

from gateway.config import Config
from gateway.errors import ConfigError
from gateway.values import Value


def wanted_keys(config: Config, names: list[str] | None) -> list[str]:
    """The key expressions of what was named: tags, devices, wildcards. Raises `ConfigError`."""
    if not names:
        return ["**"]
    known = [tag.key for device in config.devices for tag in device.tags]
    devices = {device.name for device in config.devices}
    wanted = []
    for name in names:
        if name in devices:
            name = f"{name}/**"
        try:
            found = any(matches(key, [name]) for key in known)
        except zenoh.ZError:
            raise ConfigError(f"{name} is no tag, and no wildcard such as 'mixer/**'") from None
        if not found:
            raise ConfigError(f"there is no tag or device {name}")
        wanted.append(name)
    return wanted


def matches(key: str, wanted: list[str]) -> bool:
    """Raises `ZError` for what is no key expression."""
    return any(zenoh.KeyExpr(want).intersects(zenoh.KeyExpr(key)) for want in wanted)


def parse_value(text: str) -> Value:
    """A value as typed in a shell: a JSON scalar (`true`, `12.5`, `"AB"`), or else text."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    if isinstance(value, float) and not math.isfinite(value):
        return text  # NaN and 1e999 are no JSON
    return value if isinstance(value, (bool, int, float, str)) else text
