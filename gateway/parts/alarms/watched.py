"""The alarms that need no setting: devices that do not reply, lines that are down or silent."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial

from gateway.contract.line_faults import line_fault
from gateway.contract.status import device_document, is_silent
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.line.line import Line
from gateway.parts.alarms.settings import AlarmsSection, WatchedSection
from gateway.plant.doors import Condition, Reading
from gateway.tags import AlarmRule, Level, Priority

# Seconds that a line is down before it is an alarm: an adapter that is plugged again, or a device
# server that starts again, is back earlier.
LINE_DELAY = 3.0
# Seconds that a device is silent until it is an alarm although no device of its line replies: they
# fall silent one after the other, and then the line is the alarm.
LINE_KNOWN = 15.0
LINE = "line:"  # begins the key of the alarm of a line; no device has a colon in its name
# The setting of each kind.
_KINDS = {
    Level.DOWN: "lines",
    Level.OFFLINE: "devices",
    Level.STOPPED: "transfers",
    Level.FAULT: "gateway",
}
_USUAL = WatchedSection()
_SILENT, _DOWN = 1.0, 2.0  # readings of a line
LevelOf = Callable[[str], Level | None]  # of an alarm that is active, by its key


def conditions(
    lines: Iterable[Line], level_of: LevelOf, now: Callable[[], float]
) -> dict[str, Condition]:
    """Returns the conditions of lines and of their devices, by the key of their alarm. `now`: by
    the line's clock."""
    found = {}
    for line in lines:
        name = line.engine.name
        key = f"{LINE}{name}"
        rule = AlarmRule(
            {Level.DOWN: _DOWN, Level.SILENT: _SILENT},
            delay=LINE_DELAY,
            priority=Priority.CRITICAL,
            text=f"line {name} is down",
            texts={Level.SILENT: f"line {name} is silent"},
        )
        found[key] = Condition(rule, partial(_line, line, partial(level_of, key), now))
        for device in line.engine.devices:
            rule = AlarmRule(
                {Level.OFFLINE: True},
                priority=Priority.HIGH,
                text=f"{device.name} does not reply",
            )
            parent = key if device.health.is_probed else ""
            found[device.name] = Condition(rule, partial(_device, line, device, now), parent)
    return found


def tuned(found: Mapping[str, Condition], config: AlarmsSection) -> dict[str, Condition]:
    """Returns the conditions that the file wants, with its delays and priorities."""
    wanted = {}
    for key, one in found.items():
        setting = _KINDS[next(iter(one.rule.limits))]
        own: bool | WatchedSection = getattr(config, setting)
        if own is False:
            continue
        own = _USUAL if own is True else own
        rule = replace(
            one.rule,
            priority=Priority(own.priority or one.rule.priority),
            delay=one.rule.delay if own.delay is None else own.delay,
            off_delay=own.off_delay,
        )
        wanted[key] = one._replace(rule=rule)
    return wanted


def _line(line: Line, level: Callable[[], Level | None], now: Callable[[], float]) -> Reading:
    engine = line.engine
    if not engine.is_open:
        # A line that was not tried yet is not down.
        return Reading(_DOWN if line.tried.is_set() else None, engine.record.trouble)
    match is_silent(engine, now()):
        case True:
            return Reading(_SILENT, _why_silent(line, now()))
        case None if level() is Level.SILENT:
            return Reading(None, "it is not known yet which devices reply again")
    return Reading(0.0)


def _why_silent(line: Line, now: float) -> str:
    """Returns the sentences of the status."""
    name, devices = line.engine.name, line.engine.devices
    documents = [(device.name, device_document(device, (), now)) for device in devices]
    told = line_fault(name, {"open": True}, documents)
    return "; ".join(one.text.removeprefix(f"line {name}: ") for one in told)


def _device(line: Line, device: Device, now: Callable[[], float]) -> Reading:
    """Not known while the line is down, before the first probes have ended, and for some seconds
    while no device of its line replies."""
    state = device.health.state
    if state is State.STARTING:
        return Reading(None)
    if state is not State.OFFLINE:
        return Reading(False)
    fell_lately = (device.record.falls.lasts(now()) or 0.0) < LINE_KNOWN
    if fell_lately and is_silent(line.engine, now()) is not False:
        return Reading(None, "it is not known yet whether it is the device or the line")
    return Reading(True, device.diagnosis())
