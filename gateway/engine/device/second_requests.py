"""The second request of a resync, where only quiet proves the first one.

A station later than `late_guard` may still reply to earlier requests. So the second request reads
the form that was requested longest ago. One without a reply is remembered: its form is none of the
row of resyncs, from which a reply is told otherwise. Where a station was later than that, the
line is quiet until an earlier second request with this form can no longer be answered.
"""

import math

from gateway.engine.device.device import Device
from gateway.protocols.driver import PROOF, Span

MOST_SILENT = 2  # second requests without a reply, until only the first choice is sent
MOST_TOKENS = 32  # among which the second request of a resync is chosen


def second_token(
    device: Device, outstanding: Span | None, token: int, now: float
) -> tuple[int, float]:
    """Returns the token of a second request: the one whose form was requested longest ago.

    With it the seconds for which the wire must be quiet before, because an earlier second request
    with this form may still be answered; 0: for no longer. `token`: the first choice, also where no
    read inside the spans has another form, or the device is silent about it.
    """
    shapes, spans, health = device.shapes, device.probe_spans, device.health
    if shapes is None or now < shapes.proofs.seconds_from:
        return token, 0.0
    inside = shapes.inside(spans, outstanding)
    found, longest_ago = token, math.inf
    for one in (PROOF, *range(token, token + MOST_TOKENS)):
        shape = shapes.of_resync(outstanding, one, spans)
        if shape in inside and (at := shapes.used_at(shape)) < longest_ago:
            found, longest_ago = one, at
    lateness, shape = health.probes.lateness(now), shapes.of_resync(outstanding, found, spans)
    if shape in health.unanswered.seconds and now - shapes.used_at(shape) < lateness:
        return found, lateness
    device.note_resync(outstanding, found, now)
    return found, 0.0


def leave_second(device: Device, outstanding: Span | None, token: int, now: float) -> None:
    """Notes that a second request has no reply."""
    shapes, seconds = device.shapes, device.health.unanswered.seconds
    if shapes is not None:
        shape = shapes.of_resync(outstanding, token, device.probe_spans)
        if shape is None:  # no other reply can have it
            return
        seconds.append(shape)
        if len(seconds) >= MOST_SILENT and not device.health.probes.was_late(now):
            shapes.proofs.lacks_seconds(now)


def is_like_a_second(device: Device, outstanding: Span | None, token: int) -> bool:
    """Returns True if the reply to a resync may be that to an earlier second request."""
    seconds, shapes, spans = device.health.unanswered.seconds, device.shapes, device.probe_spans
    if not seconds or shapes is None or token == PROOF:
        return False
    # A second read follows a refused one.
    return any(shapes.of_resync(outstanding, one, spans) in seconds for one in (token, token + 1))
