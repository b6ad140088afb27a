"""The rules of a line have one shape: a new one is one module, and one line in the list."""

from collections.abc import Sequence

import pytest

from gateway.engine import engine as engine_module
from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Result, Resynced, Traffic, Transacted
from gateway.engine.results.rule import Rule
from gateway.engine.rules import LineState, rules_of
from gateway.errors import Refusal, Refused
from tests.engine.rig import Rig, link_device

NAP = 3.0  # seconds


class NapAfterRefusal(Rule):
    """A toy: a device that refuses an address is not polled for three seconds."""

    def __init__(self) -> None:
        self.until: dict[Device, float] = {}
        self.ticks: list[float] = []

    def free(self, device: Device, now: float) -> float:
        return self.until.get(device, now)

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        if isinstance(result, Refused):
            self.until[job.device] = now + NAP

    @property
    def due(self) -> float:
        return min(self.until.values(), default=float("inf"))

    def tick(self, now: float, time: int) -> None:
        self.ticks.append(now)
        self.until = {one: until for one, until in self.until.items() if until > now}


def test_a_rule_of_a_test_holds_a_device_is_asked_again_and_lets_it_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    toy = NapAfterRefusal()

    def with_toy(line: LineState) -> Sequence[Rule]:
        return (*rules_of(line), toy)

    monkeypatch.setattr(engine_module, "rules_of", with_toy)
    rig = Rig(link_device(station=1), link_device(station=2))
    for _ in rig.devices:
        probe = rig.transacted()
        assert isinstance(probe, Probe)
        rig.conclude(probe, Resynced(1))
    job = rig.transacted()
    assert isinstance(job, Poll)
    rig.conclude(job, Refused("no such address", code="07", refusal=Refusal.ADDRESS))
    refused, napping = job.device, rig.now + NAP
    assert rig.engine.deadline == napping
    asked = []
    while rig.now < napping:
        following = rig.next()
        if isinstance(following, Idle):
            rig.now = min(following.until, napping)
        elif isinstance(following, Poll):
            asked.append(following.device)
            rig.conclude(following, [0] * following.span.size)
    assert asked
    assert refused not in asked
    rig.note(rig.engine.expire(rig.now, rig.time))
    assert toy.ticks == [rig.now]
    assert rig.transacted().device is refused


def test_a_rule_that_lacks_a_method_costs_nothing_there() -> None:
    rules = Rig().engine.rules
    assert not rules.beside  # no device takes several requests at once
    assert len(rules.concluded) < len(rules.all)
