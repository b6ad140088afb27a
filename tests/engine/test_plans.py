"""Plans of a running line: few, bounded, and together a small share of the time."""

import random
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from gateway.engine.device import device as engine_device
from gateway.engine.device.device import MOST_PLANNED, PLANNING, Device
from gateway.engine.device.health import State
from gateway.engine.device.turnaround import LEARN_EVERY
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Traffic
from gateway.engine.schedule.replan_budget import PLANNING_SHARE
from gateway.errors import Refusal, Refused
from gateway.planning.planner import Block, plan
from gateway.protocols.modbus import ModbusTcp
from tests.engine.rig import Rig
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

ADDRESS = Refused("no such address", code="02", refusal=Refusal.ADDRESS)


@dataclass
class Plans:
    """The plans since the start: the tags of each and its time."""

    rig: Rig | None = None
    found: list[tuple[float, int]] = field(default_factory=list)

    def __call__(self, tags: Sequence[Any], *rest: Any) -> tuple[Block, ...]:
        if self.rig is not None:
            self.found.append((self.rig.now, len(tags)))
        return plan(tags, *rest)

    @property
    def share(self) -> float:
        """The estimated share of the time, without the last plan: a pause follows each."""
        seconds = sum(tags * PLANNING for _, tags in self.found[:-1])
        return seconds / (self.found[-1][0] - self.found[0][0])


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> Plans:
    found = Plans()
    monkeypatch.setattr(engine_device, "plan", found)
    return found


def registers(count: int, every: float = 1.0, step: int = 1) -> Device:
    driver = ModbusTcp(station=1)
    tags = [
        make_tag(f"holding:{step * n}", driver, type="uint16", every=every) for n in range(count)
    ]
    return made_device("tcp", driver, WIRE, replace(driver.timing, retries=1), tags)


def serve(rig: Rig, until: float, missing: range = range(0), jitter: float = 0.0) -> None:
    """Serves the device: it refuses requests for missing addresses."""
    chance = random.Random(1)
    while rig.now < until:
        job = rig.next()
        turnaround = 0.001 * chance.uniform(1 - jitter, 1 + jitter)
        traffic = Traffic(sent=12, heard=20, exchanges=1, turnaround=turnaround)
        match job:
            case Idle():
                rig.now = min(until, job.until)
            case Probe():
                rig.conclude(job, Resynced(9), traffic, 0.002)
            case Poll(span=span):
                start, size = span.start, span.size
                refused = any(n in missing for n in range(start, start + size))
                rig.conclude(job, ADDRESS if refused else [0] * size, traffic, 0.002)


def test_many_addresses_that_return_at_once_are_planned_together(plans: Plans) -> None:
    rig = Rig(registers(1000))
    plans.rig = rig
    serve(rig, 400.0, missing=range(990))
    assert len(rig.device.bad_addresses.bad) == 990
    plans.found.clear()
    serve(rig, 800.0)
    assert rig.device.bad_addresses.clear
    assert [block.span.size for block in rig.device.blocks] == [125] * 8
    assert sum(tags for _, tags in plans.found) <= 5 * 1000
    assert len(plans.found) <= 3


def test_plans_take_a_hundredth_of_the_time_and_each_is_bounded(plans: Plans) -> None:
    """Each holds up the other lines; half of the addresses come and go."""
    rig = Rig(registers(2500))
    plans.rig = rig
    for turn in range(3):
        serve(rig, 50.0 * turn + 25.0, missing=range(500, 2000))
        serve(rig, 50.0 * turn + 50.0)
    assert len(plans.found) > 4
    assert plans.share <= 1.05 * PLANNING_SHARE
    assert max(tags for _, tags in plans.found) <= MOST_PLANNED + 5 * 125


def test_learning_does_not_chase_jitter(plans: Plans) -> None:
    rig = Rig(registers(60, every=0.02, step=9))
    plans.rig = rig
    serve(rig, 60.0, jitter=0.9)
    assert rig.device.record.exchanges > 100 * LEARN_EVERY
    assert len(plans.found) <= 9


def test_a_turnaround_that_cannot_make_the_plan_cheaper_plans_nothing(plans: Plans) -> None:
    """A longer one costs a single request nothing that another plan could save."""
    dev = registers(3, step=2)
    plans.rig = Rig(dev)
    plans.rig.bring(State.ONLINE)
    dev.record.replies.turnaround = dev.timing.turnaround / 3
    dev.record.exchanges = LEARN_EVERY
    assert dev.learn_turnaround() is None
    assert plans.found == []


def test_plans_that_change_nothing_become_rare(plans: Plans) -> None:
    dev = registers(2)
    plans.rig = Rig(dev)
    for n in range(1, 2000):
        dev.record.exchanges = n * LEARN_EVERY
        dev.record.replies.turnaround = 0.1 if n % 2 else 1.0
        assert not dev.learn_turnaround()
    assert len(plans.found) <= 7 + 2000 / 128 + 1
