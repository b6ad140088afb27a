"""Reads only the part of the file that a client needs to reach its gateway."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gateway.config.messages import Mistakes, OptionPlaces
from gateway.config.settings import parsers
from gateway.config.settings.zenoh_records import (
    LISTEN,
    NAME,
    TlsConfig,
    ZenohConfig,
    ZenohMode,
    with_files,
)
from gateway.config.yaml.events import first_sections
from gateway.config.yaml.file import TEXTS, file_text
from gateway.errors import ConfigError

if TYPE_CHECKING:
    from gateway.engine.device.device_settings import DeviceSettings

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayAddress:
    """The gateway of a file: its name and its Zenoh session. A `Config` without devices."""

    name: str
    standby: str | None
    zenoh: ZenohConfig
    devices: "tuple[DeviceSettings, ...]" = ()

    @property
    def dialling(self) -> Mapping[str, float]:
        """As in `Config`."""
        return {}


def address(path: Path) -> GatewayAddress | None:
    """Returns the address of the gateway, without a check of the rest of the file.

    None where the two sections have a mistake, or cannot be read without the rest: `load` then
    says what is wrong, with its place.
    """
    mistakes = Mistakes(OptionPlaces())
    try:
        data = first_sections(file_text(path).encode(), TEXTS, ("gateway", "zenoh"))
        if data is None:
            return None
        gateway = _settings(data.get("gateway", {}), _GATEWAY)
        zenoh = ZenohConfig(**{"listen": LISTEN} | _settings(data.get("zenoh", {}), _ZENOH))
        zenoh.check()
    except ValueError:  # and `ConfigError`, which is one
        return None
    zenoh = with_files(zenoh, path.parent, mistakes.at("zenoh"))
    if len(mistakes) or ("standby_alone" in gateway and "standby" not in gateway):
        return None
    return GatewayAddress(
        name=gateway.get("name", NAME), standby=gateway.get("standby"), zenoh=zenoh
    )


def _settings(raw: object, parse: Mapping[str, Callable[[Any], object]]) -> dict[str, Any]:
    """Returns the settings of a section, parsed. Raises `ConfigError` at any mistake."""
    if not isinstance(raw, dict) or not raw.keys() <= parse.keys():
        raise ConfigError("the sections need a whole check")
    return {name: parse[name](value) for name, value in raw.items()}


def _endpoints(raw: object) -> tuple[str, ...]:
    return tuple(parsers.endpoint(one) for one in _of(list, raw))


def _listen(raw: object) -> tuple[str, ...]:
    return tuple(parsers.once(list(_endpoints(raw))))


def _tls(raw: object) -> TlsConfig:
    tls = TlsConfig(**_settings(raw, _TLS))
    tls.check()
    return tls


def _of(kind: type[T], raw: object) -> T:
    if not isinstance(raw, kind):
        raise ConfigError(f"{raw!r} is no {kind.__name__}")
    return raw


# The settings of `GatewaySection` and `ZenohSection`, without pydantic: importing it takes a third
# of the time of a short command.
_FLAG = partial(_of, bool)
_GATEWAY: Mapping[str, Callable[[Any], object]] = {
    "name": parsers.name,
    "standby": parsers.name,
    "standby_alone": parsers.interval,
    "state": parsers.path,
    "watch_config": _FLAG,
    "secret_file": parsers.path,
}
_TLS: Mapping[str, Callable[[Any], object]] = {
    "ca": parsers.path,
    "certificate": parsers.path,
    "key": parsers.path,
    "mutual": _FLAG,
}
_ZENOH: Mapping[str, Callable[[Any], object]] = {
    "prefix": parsers.prefix,
    "mode": ZenohMode,
    "listen": _listen,
    "connect": _endpoints,
    "config_file": parsers.path,
    "tls": _tls,
    "user": partial(_of, str),
    "password_file": parsers.path,
    "users_file": parsers.path,
    "refresh": parsers.interval,
}
