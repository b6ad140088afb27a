"""Effects are collected in their order and handed over once."""

from gateway.engine.effects import (
    Effects,
    LogEvent,
    OnlineChange,
    Pause,
    RequestEnded,
    Samples,
)
from gateway.engine.jobs.requests import Command
from gateway.errors import Busy
from gateway.tags import Reason, bad, good
from tests.sim.plant import device, make_tag

TAG, BUSY = make_tag("D0"), Busy("not now")


def test_effects_are_taken_once_and_in_their_order() -> None:
    dev, effects = device([TAG]), Effects()
    command = Command(dev, "stop", "", 0.0)
    effects.online(dev, True)
    effects.samples([good(TAG, 5, 1)])
    effects.bad([TAG], Reason.REFUSED, 2, "28")
    effects.unsent(command, BUSY)
    effects.pause(0.1)
    assert effects.take() == [
        OnlineChange(dev, True),
        Samples([good(TAG, 5, 1)]),
        Samples([bad(TAG, Reason.REFUSED, 2, "28")]),
        RequestEnded(command, BUSY),
        Pause(0.1),
    ]
    assert effects.take() == []


def test_log_events_keep_their_level_and_fields() -> None:
    effects = Effects()
    effects.debug("stray frame", count=1)
    effects.info("device online", device="plc1")
    effects.warning("device offline", device="plc1", why="no reply")
    assert effects.take() == [
        LogEvent("debug", "stray frame", {"count": 1}),
        LogEvent("info", "device online", {"device": "plc1"}),
        LogEvent("warning", "device offline", {"device": "plc1", "why": "no reply"}),
    ]
