"""Commands to PLCs (run, stop, loopback, model): permission and destination."""

from collections.abc import Mapping

from gateway.config import Config, LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.jobs.requests import why_not_commanded
from gateway.errors import BadValue
from gateway.protocols.capabilities import Controllable

TO_ALL = "global"  # goes to every station of the line; no station replies


class NotControlled(BadValue):
    """The file has no `control: true` for the device; nothing has been sent."""


def commands_of(device: DeviceSettings) -> frozenset[str]:
    """Returns the commands of the protocol, permitted or not."""
    if device.served is not None:  # the gateway is this PLC
        return frozenset()
    return device.driver.controls if isinstance(device.driver, Controllable) else frozenset()


def every_command(config: Config) -> Mapping[str, frozenset[str]]:
    """Returns the commands by device, without `TO_ALL`, which belongs to the line."""
    found = {device.name: commands_of(device) - {TO_ALL} for device in config.devices}
    return {name: commands for name, commands in found.items() if commands}


def speaker(config: Config, line: str) -> str:
    """Returns the device that sends `TO_ALL` to the line. Raises `BadValue`."""
    for one in config.lines:
        if one.name == line:
            for device in one.devices:
                if device.enabled and TO_ALL in commands_of(device):
                    return device.name
            raise BadValue(f"no device of line {line} has a command to all stations")
    raise BadValue(f"there is no line {line}")


def line_of(config: Config, device: str) -> LineConfig:
    """Raises `BadValue`."""
    for line in config.lines:
        if any(one.name == device for one in line.devices):
            return line
    raise BadValue(f"there is no device {device}")


def check_command(config: Config, device: str, command: str) -> None:
    """Raises `BadValue` for an unknown command, `NotControlled` for one without permission.

    A command to all stations needs the permission of every device that carries it out.
    """
    line = line_of(config, device)
    (asked,) = (one for one in line.devices if one.name == device)
    if asked.served is not None:
        raise BadValue(f"{device} is a station of this gateway: it takes no commands")
    if why := why_not_commanded(asked.driver, command, control=True):
        raise BadValue(f"{device}: {why}")
    if not asked.enabled:
        raise BadValue(f"device {device} is disabled")
    receivers = [one for one in line.devices if one is asked or command == TO_ALL]
    for one in receivers:
        if command in commands_of(one) and not one.control:
            raise NotControlled(f"{one.name} does not permit commands: it has no `control: true`")
