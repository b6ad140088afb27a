"""The protocols of the gateway, by the name that follows `protocol:` in the file.

Another package adds one by an entry point of the group `gateway.protocols`. It is imported when a
file names the protocol, so a package that fails concerns no other file.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gateway.errors import ConfigError
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Addressing, AnyDriver, Driver
from gateway.protocols.frames import FrameDriver, Frames
from gateway.protocols.fx.driver import Fx
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor


@dataclass(frozen=True, slots=True)
class Protocol:
    """`settings`: a dataclass whose fields are the settings in the file; `driver` takes one."""

    settings: type[Any]
    driver: Callable[[Any], AnyDriver]


_GROUP = "gateway.protocols"
_PROTOCOLS: dict[str, Protocol] = {}
_FAULTS: dict[str, str] = {}  # of other packages


class _Protocols(Mapping[str, Protocol]):
    def __getitem__(self, name: str) -> Protocol:
        if name not in _PROTOCOLS and name not in _FAULTS:
            try:
                _register_from(name, list(entry_points(group=_GROUP, name=name)))
            except ConfigError as error:
                _FAULTS[name] = str(error)
        return _PROTOCOLS[name]

    def __iter__(self) -> Iterator[str]:
        return iter([name for name in (*_PROTOCOLS, *self._others()) if name in self])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _others(self) -> set[str]:
        return entry_points(group=_GROUP).names - _PROTOCOLS.keys()


PROTOCOLS: Mapping[str, Protocol] = _Protocols()


def fault_of(name: str) -> str | None:
    """Returns why the package of a protocol cannot be used."""
    return _FAULTS.get(name)


def register(driver: type[AnyDriver], settings: type[Any] | None = None) -> None:
    """Adds a protocol; its name is the default of the setting `protocol`.

    A driver is usually its own settings. With `settings`, the driver is made from an instance of
    that class.
    """
    build: Callable[..., AnyDriver] = driver
    added = (
        Protocol(driver, lambda itself: itself) if settings is None else Protocol(settings, build)
    )
    name = _name_of(added.settings)
    if name in _PROTOCOLS:
        raise ValueError(f"there is a protocol {name} already")
    _PROTOCOLS[name] = added


def _register_from(name: str, entries: Sequence[EntryPoint]) -> None:
    """Adds the protocol of another package, if there is one. Raises `ConfigError`."""
    if not entries:
        return
    packages = [f"{one.dist.name} {one.dist.version}" for one in entries if one.dist is not None]
    fault = f"the protocol {name} of {' and '.join(packages)} cannot be used"
    if len(entries) > 1:
        raise ConfigError(f"{fault}: remove one of them")
    try:
        driver = entries[0].load()
        missing = (_members(Driver) | _members(Addressing)) - {*dir(driver)}
        own = _name_of(driver)
    except Exception as error:  # the code of others
        raise ConfigError(f"{fault}: {type(error).__name__}: {error}") from error
    if missing:
        raise ConfigError(f"{fault}: its driver has no {', '.join(sorted(missing))}")
    if own != name:
        raise ConfigError(f"{fault}: its driver calls itself {own}")
    register(driver)


def _name_of(settings: type[Any]) -> str:
    return str({field.name: field.default for field in fields(settings)}["protocol"])


def _members(contract: type) -> set[str]:
    return {name for name in vars(contract) if not name.startswith("_")}


register(Vigor)
register(ComputerLink)
register(ModbusRtu)
register(ModbusAscii)
register(ModbusTcp)
register(Fx)
register(FrameDriver, settings=Frames)
