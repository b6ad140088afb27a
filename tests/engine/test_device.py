"""A device's standing, its doubts, its record and what it says is the matter."""

import pytest

from gateway.engine.device import Device
from gateway.engine.health import State
from gateway.errors import Evidence, Garbled, NoReply, Unclear
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Reason
from tests.sim.plant import WIRE, device, made_device, make_tag, words


@pytest.fixture
def dev() -> Device:
    return device(words(0, 10))


def test_a_device_starts_in_doubt_for_answers_to_an_earlier_gateway_may_still_come(
    dev: Device,
) -> None:
    assert dev.state is State.STARTING
    assert dev.health.needs_resync
    assert not dev.health.online


def test_an_answer_ends_all_doubt(dev: Device) -> None:
    dev.failed(NoReply("silence"), Span("D", 0, 10), 0.0)
    dev.health.answered()
    assert (dev.state, dev.failures, dev.health.needs_resync, dev.health.outstanding) == (
        State.ONLINE,
        0,
        False,
        None,
    )
    assert dev.diagnosis() == ""


def test_a_failure_of_a_device_that_answered_makes_it_failing(dev: Device) -> None:
    dev.health.answered()
    dev.failed(NoReply("silence"), Span("D", 0, 10), 0.0)
    assert dev.state is State.FAILING
    assert dev.health.online
    assert dev.health.needs_resync


@pytest.mark.parametrize("standing", [State.STARTING, State.OFFLINE])
def test_a_failure_of_one_that_did_not_leaves_it_so(dev: Device, standing: State) -> None:
    dev.state = standing
    dev.failed(NoReply("silence"), None, 0.0)
    assert dev.state is standing


def test_a_probe_that_fails_does_not_forget_what_may_still_be_answered(dev: Device) -> None:
    dev.failed(NoReply("silence"), Span("D", 0, 10), 0.0)
    dev.failed(NoReply("silence"), None, 0.0)
    assert dev.health.outstanding == Span("D", 0, 10)


def test_a_reopened_line_leaves_the_doubt(dev: Device) -> None:
    dev.health.answered()
    dev.health.outstanding = Span("D", 0, 10)
    dev.start()
    assert dev.state is State.STARTING
    assert dev.health.needs_resync
    assert dev.health.outstanding == Span("D", 0, 10)


def test_who_is_slow_is_not_called_dead_when_nobody_waits_for_it(dev: Device) -> None:
    dev.trouble = Garbled("it took 0.7 s", evidence=Evidence.SLOW)
    dev.failed(NoReply("silence"), None, 0.0)
    assert "raise reply_timeout" in dev.diagnosis()
    dev.failed(Garbled("noise"), None, 0.0)
    assert "baud rate" in dev.diagnosis()


@pytest.mark.parametrize("evidence", [e for e in Evidence if e is not Evidence.SILENCE])
def test_every_evidence_has_its_sentence(dev: Device, evidence: Evidence) -> None:
    dev.failed(Garbled("what was heard", evidence=evidence), None, 0.0)
    assert "what was heard" in dev.diagnosis()
    assert "not understood" not in dev.diagnosis()
    assert dev.reason is Reason.GARBLED
    assert dev.record.failures[evidence] == 1


def test_silence_has_its_sentence(dev: Device) -> None:
    dev.failed(NoReply("no reply"), None, 0.0)
    assert dev.diagnosis().startswith("No byte came back")
    assert dev.reason is Reason.NO_REPLY
    dev.failed(Unclear("something else"), None, 0.0)
    assert dev.diagnosis() == "something else"
    assert dev.record.failures["other"] == 1


def test_the_turnaround_is_smoothed_over_about_ten(dev: Device) -> None:
    dev.measured(0.010)
    assert dev.record.turnaround == 0.010
    for _ in range(10):
        dev.measured(0.020)
    assert dev.record.turnaround is not None
    assert 0.0155 < dev.record.turnaround < 0.0175


def test_the_load_is_the_share_of_the_lines_time(dev: Device) -> None:
    (block,) = dev.blocks
    assert dev.load == pytest.approx(dev.seconds(block.cost) / block.every)
    assert device([]).load == 0


def test_a_device_without_a_readable_tag_is_a_broadcast() -> None:
    everybody = ModbusRtu(station=0)
    tags = (make_tag("holding:1", everybody),)
    assert made_device("all", everybody, WIRE, everybody.timing, tags, 0.5).broadcast
    assert not device([make_tag("D0")]).broadcast


def test_a_device_without_tags_that_could_be_read_is_none() -> None:
    """It may be told to run and to stop: a late answer must not acknowledge the next command."""
    assert not device([]).broadcast
    assert device([]).health.needs_resync


def test_nothing_is_planned_where_the_turnaround_is_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dev, planned = device([make_tag("D0"), make_tag("D42")]), list[float]()
    monkeypatch.setattr(Device, "plan", lambda self: planned.append(self.turnaround.expected))
    for turnaround in (0.030, 0.031, 0.029, 0.028, 0.040):
        dev.record.turnaround = turnaround
        dev.record.exchanges += 50
        dev.learn_turnaround()
        assert dev.turnaround.expected == turnaround
    assert planned == [0.030, 0.040]


def test_a_measured_turnaround_that_changes_the_optimum_plans_anew() -> None:
    tags = [make_tag("D0"), make_tag("D14"), make_tag("D28"), make_tag("D42")]
    dev = device(tags)  # reckoned with the protocol's 5 ms
    assert len(dev.blocks) == 4
    dev.measured(0.060)
    dev.record.exchanges = 49
    assert not dev.learn_turnaround()
    dev.record.exchanges = 50
    assert dev.learn_turnaround()
    assert len(dev.blocks) < 4
    assert not dev.learn_turnaround()


def test_a_turnaround_set_in_the_file_is_not_learned_over() -> None:
    known = device([make_tag("D0"), make_tag("D14"), make_tag("D28")])
    dev = made_device(
        "plc", known.driver, known.wire, known.timing, known.tags, 0.5, turnaround=0.005
    )
    dev.measured(0.5)
    dev.record.exchanges = 1000
    assert not dev.learn_turnaround()


def test_a_measured_turnaround_is_reckoned_with_though_the_plan_stays() -> None:
    """And what the file sets (here nothing) stays what it is: a broadcast is held by that alone."""
    dev = device([make_tag("D0")])
    blocks = dev.blocks
    dev.measured(0.060)
    dev.record.exchanges = 50
    before = dev.load
    assert not dev.learn_turnaround()
    assert dev.blocks is blocks
    assert (dev.turnaround.expected, dev.turnaround) == (0.060, None)
    assert dev.load > before


def test_use_of_the_wire_is_forgotten_by_halves() -> None:
    dev = device([make_tag("D0")])
    dev.used(100.0, 96.0)
    assert dev.recent_use(100.0) == 4.0
    assert dev.recent_use(110.0) == pytest.approx(2.0)
    dev.used(110.0, 109.0)
    assert dev.recent_use(110.0) == pytest.approx(3.0)
