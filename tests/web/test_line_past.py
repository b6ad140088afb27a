"""The timeline of a line: one entry for each state, with its first cause, and a bound."""

from collections.abc import Mapping
from typing import Any

import pytest

from gateway.parts.web.line_past import KEPT_STATES, Loads
from tests.northbound.plant import mixer
from tests.web.serving import DOCUMENTS, PlainNorth, core_of

SILENT: Mapping[str, Any] = DOCUMENTS["devices/oven"]


@pytest.fixture
def loads() -> Loads:
    return Loads(core_of(mixer(), PlainNorth()))


def documents(line: Mapping[str, Any], **oven: Any) -> dict[str, Any]:
    return {
        **DOCUMENTS,
        "lines/hall": {**DOCUMENTS["lines/hall"], **line},
        "devices/oven": {**SILENT, **oven},
    }


def test_a_state_is_noted_once_with_its_cause_and_without_its_figures(loads: Loads) -> None:
    for at in range(3):
        loads.note(documents({}, silent_for=60.0 * at, silences=at), 1000 * at)
    [(first, kind, cause)] = loads.timelines["hall"]
    assert (first, kind) == (0, "wrong")
    assert cause == ("oven is silent: No byte came back: check power, wiring and station number")
    loads.note(documents({}, standing="up", diagnosis=""), 3000)
    loads.note(documents({"open": False, "trouble": "cable pulled"}, standing="up"), 4000)
    assert loads.timelines["hall"][1:] == (
        (3000, "well", ""),
        (4000, "wrong", "line hall is down: cable pulled"),
    )
    shares = {"lately": {"requests": 200, "failed": {"noise": 148}}}
    for at, failed in enumerate((148, 151)):
        shares["lately"]["failed"] = {"noise": failed}
        both = documents({}, **shares)
        both["devices/mixer"] = {**both["devices/oven"]}
        loads.note(both, 5000 + at)
    assert len(loads.timelines["hall"]) == 4
    assert "74%" not in loads.timelines["hall"][-1][2]


def test_an_overloaded_line_has_a_warning_and_no_green_timeline(loads: Loads) -> None:
    both = documents({"expected": {"load": 1.84}}, standing="up", diagnosis="")
    loads.note(both, 0)
    assert loads.timelines["hall"] == (
        (0, "warning", "line hall: asked for 1.8 times what it carries: see `check`"),
    )


def test_a_silent_line_that_is_opened_again_is_not_well_meanwhile(loads: Loads) -> None:
    starts = {"devices": {"mixer": "up", "oven": "starting"}}
    loads.note(documents({"open": False, "trouble": ""}), 0)
    assert loads.timelines["hall"] == ((0, "starting", ""),)
    for at in (1, 3):
        loads.note(documents({}), at)
        loads.note(documents(starts, standing="starting", diagnosis=""), at + 1)
    assert [state[:2] for state in loads.timelines["hall"]] == [(0, "starting"), (1, "wrong")]
    loads.note(documents({"devices": {"mixer": "up"}}), 5)
    assert loads.timelines["hall"][-1] == (5, "well", "")


def test_a_line_that_flaps_keeps_its_newest_states_and_one_that_has_gone_none(
    loads: Loads,
) -> None:
    for at in range(3 * KEPT_STATES):
        loads.note(documents({"open": bool(at % 2), "trouble": "lost"}), at)
    states = loads.timelines["hall"]
    assert len(states) == KEPT_STATES
    assert states[-1][0] == 3 * KEPT_STATES - 1
    loads.note({name: one for name, one in DOCUMENTS.items() if name != "lines/hall"}, 9999)
    assert loads.timelines == {}
