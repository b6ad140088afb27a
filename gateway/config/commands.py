"""Commands to PLCs (run, stop, loopback, model): what the file allows, and through whom."""

from collections.abc import Mapping

from gateway.config import Config, LineConfig
from gateway.engine.device import DeviceSettings
from gateway.engine.requests import why_not_commanded
from gateway.errors import BadValue
from gateway.protocols.driver import Controllable

TO_ALL = "global"  # every station of the line hears it, and none answers


class NotControlled(BadValue):
    """The file does not say `control: true`; nothing has been sent."""


def commands_of(device: DeviceSettings) -> frozenset[str]:
    """What a device of this protocol can be told, allowed or not."""
    return device.driver.controls if isinstance(device.driver, Controllable) else frozenset()


def every_command(config: Config) -> Mapping[str, frozenset[str]]:
    """By device; only those whose protocol has commands. `TO_ALL` belongs to the line."""
    found = {device.name: commands_of(device) - {TO_ALL} for device in config.devices}
    return {name: commands for name, commands in found.items() if commands}


def speaker(config: Config, line: str) -> str:
    """The device in whose name a line tells all its stations. Raises `BadValue`."""
    for one in config.lines:
        if one.name == line:
            for device in one.devices:
                if device.enabled and TO_ALL in commands_of(device):
                    return device.name
            raise BadValue(f"no device of line {line} knows a command to all stations")
    raise BadValue(f"there is no line {line}")


def line_of(config: Config, device: str) -> LineConfig:
    """Raises `BadValue`."""
    for line in config.lines:
        if any(one.name == device for one in line.devices):
            return line
    raise BadValue(f"there is no device {device}")


def check_command(config: Config, device: str, command: str) -> None:
    """Raises `BadValue` for a command that is none, `NotControlled` for one not allowed.

    What goes to all stations is allowed only where every device that would obey allows it.
    """
    line = line_of(config, device)
    (asked,) = (one for one in line.devices if one.name == device)
    if why := why_not_commanded(asked.driver, command, control=True):
        raise BadValue(f"{device}: {why}")
    if not asked.enabled:
        raise BadValue(f"device {device} is disabled")
    hears = [one for one in line.devices if one is asked or command == TO_ALL]
    for one in hears:
        if command in commands_of(one) and not one.control:
            raise NotControlled(f"{one.name} is not to be told: it has no `control: true`")
