"""Time-outs of probes, and the time within which a device that returned is seen."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.health import Heard
from gateway.engine.device.probe_pace import PROBE_PAUSE, PROBE_SPREAD

PATIENT_AFTER = 15  # short probes of a device before one that waits for the whole `reply_timeout`
USUAL = 3.0  # a short probe waits so many times the usual turnaround,
SHORTEST = 0.05  # but at least so many seconds,
UNKNOWN = 0.1  # and so many while no station of the protocol has replied
CHARACTERS = 50  # of a probe and its reply, at most about
OFFLINE_SHARE = 0.05  # share of the wire time of all offline devices together, beside idle time
ONE_OFFLINE = 0.015  # of one behind a network: each of its probes waits for `reply_timeout`


def order_of_start(device: Device) -> tuple[bool, bool]:
    """Devices that were not probed yet go first, of these the ones that replied last time."""
    return device.health.probes.short > 0, device.health.heard is not Heard.REPLIED


def short_timeout(device: Device, devices: Sequence[Device]) -> float | None:
    """Returns the reply time-out of a short probe; None: the device gets only patient ones.

    `devices`: of the line. Where there is no other, none waits for the wire.
    """
    if len(devices) == 1 or not _may_be_short(device):
        return None
    usual = device.usual_turnaround
    if usual is None:
        protocol = device.driver.protocol
        neighbours = (other for other in devices if other.driver.protocol == protocol)
        found = (other.usual_turnaround for other in neighbours)
        usual = max((known for known in found if known is not None), default=None)
    wait = UNKNOWN if usual is None else max(USUAL * usual, SHORTEST)
    return min(wait, device.timing.reply_timeout)


def brief_timeout(device: Device) -> float | None:
    """Returns the reply time-out of a short probe for a device that is known to reply sooner."""
    usual = device.usual_turnaround
    if usual is None or not _may_be_short(device):
        return None
    return min(max(USUAL * usual, SHORTEST), device.timing.reply_timeout)


def _may_be_short(device: Device) -> bool:
    """Returns False if a late reply would not name its station, or behind a network.

    A network device may be a bridge, which goes on waiting for a dead station when the gateway no
    longer does.
    """
    traits = device.driver.traits
    return traits.numbered and not traits.over_network


def is_noisy(device: Device, devices: Sequence[Device], now: float) -> bool:
    """Returns True if replies of the device are damaged on the way.

    Where a device of the line replied late, they may have met that reply: its own may be late, too.
    """
    late = any(other.health.probes.was_late(now) for other in devices)
    return device.health.probes.is_alive(now) and not late


def offline_share(silent: int, *, over_network: bool) -> float:
    """Returns the share of the wire time of so many offline devices, beside idle time."""
    return min(OFFLINE_SHARE, silent * ONE_OFFLINE) if over_network else OFFLINE_SHARE


def probe_seconds(device: Device, timeout: float | None = None) -> float:
    """Returns the seconds of an unanswered probe. `timeout` None: a patient one."""
    wait = device.timing.reply_timeout if timeout is None else timeout
    return device.silence.safe + CHARACTERS * device.wire.character + wait


def seen_within(
    devices: Sequence[Device], load: float, requests: float, longest: float
) -> tuple[float, float]:
    """Returns the seconds until a device that returned is seen.

    The first figure is for a line on which all but one are silent. The second one is for the number
    of silent devices that delays it most.

    `load`: share of the wire for polls. `requests`: polls a second. `longest`: seconds of a poll.
    """
    answerable = [device for device in devices if not device.broadcast]
    one_round, lost, idle = 0.0, 0.0, 1.0
    for device in answerable:
        patient = probe_seconds(device)
        if len(devices) == 1 or not _may_be_short(device):
            one_round += patient
            if device.driver.traits.over_network and len(devices) > 1:
                idle = 0.0
            continue
        expected = device.turnaround.expected or device.timing.turnaround
        wait = min(max(USUAL * expected, SHORTEST), device.timing.reply_timeout)
        brief = probe_seconds(device, wait)
        one_round += (PATIENT_AFTER * brief + patient) / (PATIENT_AFTER + 1)
        if brief > longest:  # it must fit between two polls
            lost = max(lost, requests * brief)
    count, times = len(answerable), [0.0]
    for silent in range(1, max(count, 2)):  # at least one replies, if there are several
        healthy = 1.0 - silent / count if count else 0.0
        least = offline_share(silent, over_network=not idle)
        share = max(idle * (1.0 - healthy * (load + lost)), least)
        times.append((1.0 - healthy) * one_round / share)
    pause = PROBE_PAUSE * (1.0 + PROBE_SPREAD) + longest
    return pause + times[-1], pause + max(times)
