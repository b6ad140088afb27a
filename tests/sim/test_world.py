"""Whole gateways with faults: a short part of `make sim`."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.sim import stations
from tests.sim.draw import Drawn, draw
from tests.sim.world import run

ROOT = Path(__file__).parents[2]
LEAN, BUSY, HOSTILE = (0, 1, 2, 10, 16, 39), range(100, 103), (100_000, 100_001)
GROUPS = (700_102,)
LATER = 910_300  # with arrays and transfers


def test_the_seeds_contain_every_protocol_setting_and_fault() -> None:
    """Each is in one of the plants of the tests below."""
    slice_of = [*(draw(n, 1800.0, "lean") for n in LEAN), *(draw(n, 150.0) for n in BUSY)]
    assert _there(slice_of) == _there(draw(n, 3600.0, "lean") for n in range(200))


def _there(plants: Iterable[Drawn]) -> set[str]:
    found: set[str] = set()
    for plant in plants:
        found |= {episode.kind for episode in plant.episodes}
        for line in plant.document["lines"].values():
            found |= {name for name, setting in line.items() if setting is True}
            for device in line["devices"].values():
                found |= {device["protocol"], f"window {device.get('window', 1) > 1}"}
                found |= {f"{k}: {v}" for k, v in device.items() if isinstance(v, bool)}
                found |= {"listen", "ask", "verify_reads"} & device.keys()
                found |= {"everybody"} if device.get("station") == 0 else set()
    return found


@pytest.mark.parametrize("seed", LEAN)
def test_half_an_hour_of_faults_breaks_no_rule(seed: int) -> None:
    story = run(seed, 0.5, "lean")
    assert not story.broken, "\n".join([story.replay(), *story.broken])


@pytest.mark.parametrize("seed", BUSY)
def test_minutes_on_full_wires_break_no_rule(seed: int) -> None:
    story = run(seed, 1 / 24, "busy")
    assert not story.broken, "\n".join([story.replay(), *story.broken])


@pytest.mark.parametrize("seed", HOSTILE)
def test_other_parties_on_the_line_break_no_rule(seed: int) -> None:
    story = run(seed, 0.15, "hostile")
    assert not story.broken, "\n".join([story.replay(), *story.broken])


@pytest.mark.parametrize("seed", GROUPS)
def test_groups_of_writes_break_no_rule(seed: int) -> None:
    story = run(seed, 0.03, "groups")
    assert not story.broken, "\n".join([story.replay(), *story.broken])
    assert story.counts["groups done"] < story.counts["groups"]  # some had to stop


def test_arrays_and_transfers_break_no_rule() -> None:
    story = run(LATER, 0.03, "storm")
    assert not story.broken, "\n".join([story.replay(), *story.broken])
    assert story.counts["carried WriteResult"] > 20


def test_the_runs_of_a_seed_are_equal_byte_for_byte() -> None:
    """Also in another process, whose hashes differ."""
    ask = "from tests.sim.world import run; print(run(2, 0.02).trace)"
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    other = subprocess.run(
        [sys.executable, "-c", ask], cwd=ROOT, env=environment, capture_output=True, check=True
    )
    assert run(2, 0.02).trace == other.stdout.decode().strip()
    assert run(3, 0.01).trace != run(2, 0.01).trace


def test_the_judge_reports_a_value_that_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stations return their values of a second ago."""
    moving = stations.moving

    def late(*where: Any) -> Callable[[float], int]:
        motion = moving(*where)
        return lambda now: motion(now - 1.0)

    monkeypatch.setattr(stations, "moving", late)
    story = run(0, 0.01)
    assert any("which was not in the PLC" in what for what in story.broken)
