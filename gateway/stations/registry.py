"""The simulated stations, by the name of their protocol."""

from collections.abc import Callable
from typing import Any

from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver
from gateway.stations.computer_link import computer_link_station
from gateway.stations.fx import fx_station
from gateway.stations.modbus import modbus_station
from gateway.stations.station import Station
from gateway.stations.vigor import vigor_station

_STATIONS: dict[str, Callable[[Any], Station]] = {}


def register(protocol: str, station: Callable[[Any], Station]) -> None:
    """Adds a protocol. `station` returns the station that a driver of the protocol can talk to."""
    if protocol in _STATIONS:
        raise ValueError(f"there is a station for {protocol} already")
    _STATIONS[protocol] = station


def can_simulate(driver: AnyDriver) -> bool:
    """Returns True where there is a station for the driver."""
    return driver.protocol in _STATIONS


def station_of(driver: AnyDriver) -> Station:
    """Returns a new station that the driver can talk to. Raises `ConfigError`."""
    if not can_simulate(driver):
        raise ConfigError(f"there is no simulated device for protocol {driver.protocol}")
    return _STATIONS[driver.protocol](driver)


register("vigor", vigor_station)
register("computer-link", computer_link_station)
register("fx", fx_station)
register("modbus-rtu", modbus_station)
register("modbus-ascii", modbus_station)
register("modbus-tcp", modbus_station)
