"""The protocols of the gateway, by the name that follows `protocol:` in the file."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.frames import FrameDriver, Frames
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor


@dataclass(frozen=True, slots=True)
class Protocol:
    """`settings`: a dataclass whose fields are the settings in the file; `driver` takes one."""

    settings: type[Any]
    driver: Callable[[Any], AnyDriver]


_PROTOCOLS: dict[str, Protocol] = {}
PROTOCOLS: Mapping[str, Protocol] = MappingProxyType(_PROTOCOLS)


def register(driver: type[AnyDriver], settings: type[Any] | None = None) -> None:
    """Adds a protocol; its name is the default of the setting `protocol`.

    A driver is usually its own settings. With `settings`, the driver is made from an instance of
    that class.
    """
    build: Callable[..., AnyDriver] = driver
    added = (
        Protocol(driver, lambda itself: itself) if settings is None else Protocol(settings, build)
    )
    name = str({field.name: field.default for field in fields(added.settings)}["protocol"])
    if name in _PROTOCOLS:
        raise ValueError(f"there is a protocol {name} already")
    _PROTOCOLS[name] = added


def unregister(name: str) -> None:
    """Removes a protocol."""
    del _PROTOCOLS[name]


register(Vigor)
register(ComputerLink)
register(ModbusRtu)
register(ModbusAscii)
register(ModbusTcp)
register(FrameDriver, settings=Frames)
