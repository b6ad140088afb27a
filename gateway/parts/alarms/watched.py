"""The alarms that need no setting: devices that do not reply, lines that are down."""

from collections.abc import Iterable
from functools import partial

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.line.line import Line
from gateway.parts.alarms.settings import AlarmsSection
from gateway.plant.doors import Condition, Reading
from gateway.tags import AlarmRule, Level

# Seconds that a line is down before it is an alarm: an adapter that is plugged again, or a device
# server that starts again, is back earlier.
LINE_DELAY = 3.0
LINE = "line:"  # begins the key of the alarm of a line; no device has a colon in its name


def conditions(lines: Iterable[Line], config: AlarmsSection) -> dict[str, Condition]:
    """Returns the conditions of lines and of their devices, by the key of their alarm."""
    found = {}
    for line in lines:
        name = line.engine.name
        if config.lines:
            rule = AlarmRule({Level.DOWN: True}, delay=LINE_DELAY, text=f"line {name} is down")
            found[f"{LINE}{name}"] = Condition(rule, partial(_line, line))
        for device in line.engine.devices if config.devices else ():
            rule = AlarmRule({Level.OFFLINE: True}, text=f"{device.name} does not reply")
            found[device.name] = Condition(rule, partial(_device, device))
    return found


def _line(line: Line) -> Reading:
    if line.engine.is_open:
        return Reading(False)
    # A line that was not tried yet is not down.
    return Reading(True if line.tried.is_set() else None, line.engine.record.trouble)


def _device(device: Device) -> Reading:
    """Not known while the line is down, or before the first probes have ended."""
    state = device.health.state
    if state is State.STARTING:
        return Reading(None)
    is_offline = state is State.OFFLINE
    return Reading(is_offline, device.diagnosis() if is_offline else "")
