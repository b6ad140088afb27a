"""One device: its health and diagnosis, its plan, its record and its use of the wire."""

import math

import pytest

from gateway.engine.device.device import HALF_LIFE, PROOF_COST, Device
from gateway.engine.device.health import State
from gateway.errors import Evidence, Garbled, NoReply, Unclear
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.tags import Reason
from tests.sim.bench import WIRE
from tests.sim.plant import device, made_device, make_tag, words


@pytest.fixture
def dev() -> Device:
    return device(words(0, 10))


def test_a_device_starts_with_a_resync_for_replies_to_an_earlier_gateway_may_still_arrive(
    dev: Device,
) -> None:
    assert dev.state is State.STARTING
    assert dev.health.needs_resync
    assert not dev.health.online


def test_a_reply_completes_the_resync(dev: Device) -> None:
    dev.health.unclear(NoReply("silence"), Span("D", 0, 10), 0.0)
    dev.health.answered()
    assert (
        dev.state,
        dev.health.consecutive_failures,
        dev.health.needs_resync,
        dev.health.outstanding,
    ) == (
        State.ONLINE,
        0,
        False,
        None,
    )
    assert dev.diagnosis() == ""


def test_a_failure_of_an_online_device_makes_it_failing(dev: Device) -> None:
    dev.health.answered()
    dev.health.unclear(NoReply("silence"), Span("D", 0, 10), 0.0)
    assert dev.state is State.FAILING
    assert dev.health.online
    assert dev.health.needs_resync


@pytest.mark.parametrize("state", [State.STARTING, State.OFFLINE])
def test_a_failure_of_a_device_that_is_not_online_leaves_its_state(
    dev: Device, state: State
) -> None:
    if state is State.OFFLINE:
        dev.health.gave_up(0.0, 1.0)
    dev.health.unclear(NoReply("silence"), None, 0.0)
    assert dev.state is state


def test_a_failed_probe_keeps_the_older_outstanding_request(dev: Device) -> None:
    dev.health.unclear(NoReply("silence"), Span("D", 0, 10), 0.0)
    dev.health.unclear(NoReply("silence"), None, 0.0)
    assert dev.health.outstanding == Span("D", 0, 10)


def test_a_reopened_line_keeps_the_outstanding_request(dev: Device) -> None:
    dev.health.answered()
    dev.health.left_outstanding(Span("D", 0, 10), 0.0)
    dev.restart()
    assert dev.state is State.STARTING
    assert dev.health.needs_resync
    assert dev.health.outstanding == Span("D", 0, 10)


def test_a_slow_device_keeps_that_diagnosis_when_it_does_not_reply_at_all(dev: Device) -> None:
    dev.health.unclear(Garbled("it took 0.7 s", evidence=Evidence.SLOW), None, 0.0)
    dev.health.unclear(NoReply("silence"), None, 0.0)
    assert "raise reply_timeout" in dev.diagnosis()
    dev.health.unclear(Garbled("noise"), None, 0.0)
    assert "baud rate" in dev.diagnosis()


@pytest.mark.parametrize("evidence", [e for e in Evidence if e is not Evidence.SILENCE])
def test_every_kind_of_evidence_has_its_diagnosis(dev: Device, evidence: Evidence) -> None:
    error = Garbled("the bytes", evidence=evidence)
    dev.health.unclear(error, None, 0.0)
    dev.record.count_failure(error)
    assert "the bytes" in dev.diagnosis()
    assert "not understood" not in dev.diagnosis()
    assert dev.health.reason is Reason.GARBLED
    assert dev.record.failures[evidence] == 1


def test_silence_has_its_diagnosis(dev: Device) -> None:
    dev.health.unclear(NoReply("no reply"), None, 0.0)
    assert dev.diagnosis().startswith("No byte came back")
    assert dev.health.reason is Reason.NO_REPLY
    other = Unclear("something else")
    dev.health.unclear(other, None, 0.0)
    dev.record.count_failure(other)
    assert dev.diagnosis() == "something else"
    assert dev.record.failures["other"] == 1


def test_the_diagnosis_is_that_of_most_failures_not_of_the_last_one(dev: Device) -> None:
    def fails(error: NoReply | Garbled) -> str:
        dev.health.unclear(error, None, 0.0)
        dev.record.count_failure(error)
        return dev.diagnosis()

    noise, silence = Garbled("noise"), NoReply("no reply")
    for _ in range(8):
        fails(noise)
    assert "baud rate" in fails(silence)
    for _ in range(10):
        fails(silence)
    assert fails(noise).startswith("No byte came back")


def test_a_port_that_refused_a_setting_is_the_diagnosis_of_silence(dev: Device) -> None:
    note = "The device server has baudrate 9600, not 19200: it refused it"
    dev.restart(note=note)
    assert dev.diagnosis() == ""
    dev.health.unclear(NoReply("no reply"), None, 0.0)
    assert dev.diagnosis() == note
    dev.health.answered()
    dev.health.unclear(NoReply("no reply"), None, 0.0)
    assert dev.diagnosis() != note
    dev.restart()
    dev.health.unclear(NoReply("no reply"), None, 0.0)
    assert dev.diagnosis() != note


def test_the_turnaround_is_smoothed_over_about_ten_exchanges(dev: Device) -> None:
    dev.record.count_exchanges(1, 0.0, 0.010)
    assert dev.record.replies.turnaround == 0.010
    for _ in range(10):
        dev.record.count_exchanges(1, 0.0, 0.020)
    assert dev.record.replies.turnaround is not None
    assert 0.0155 < dev.record.replies.turnaround < 0.0175


def test_the_load_is_the_polls_share_of_the_lines_time(dev: Device) -> None:
    (block,) = dev.blocks
    assert dev.load == pytest.approx(dev.seconds(block.cost) / block.every)
    assert device([]).load == 0


def test_a_device_without_a_readable_tag_is_a_broadcast() -> None:
    driver = ModbusRtu(station=0)
    tags = (make_tag("holding:1", driver),)
    assert made_device("all", driver, WIRE, driver.timing, tags).broadcast
    assert not device([make_tag("D0")]).broadcast


def test_a_device_without_any_tag_is_no_broadcast() -> None:
    """It may get commands: a late reply must not acknowledge the next command."""
    assert not device([]).broadcast
    assert device([]).health.needs_resync


def test_an_equal_turnaround_plans_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dev, planned = device([make_tag("D0"), make_tag("D42")]), list[float]()
    monkeypatch.setattr(Device, "plan", lambda self: planned.append(self.turnaround.expected))
    for turnaround in (0.030, 0.031, 0.029, 0.028, 0.090):
        dev.record.replies.turnaround = turnaround
        dev.record.exchanges += 50
        dev.learn_turnaround()
        assert dev.turnaround.expected == turnaround
    assert planned == [0.030, 0.090]


def test_a_measured_turnaround_that_changes_the_optimum_plans_again() -> None:
    tags = [make_tag("D0"), make_tag("D14"), make_tag("D28"), make_tag("D42")]
    dev = device(tags)  # planned with the protocol's 5 ms
    assert len(dev.blocks) == 4
    dev.record.count_exchanges(1, 0.0, 0.060)
    dev.record.exchanges = 49
    assert not dev.learn_turnaround()
    dev.record.exchanges = 50
    assert dev.learn_turnaround()
    assert len(dev.blocks) < 4
    assert not dev.learn_turnaround()


def test_a_turnaround_set_in_the_file_is_kept() -> None:
    known = device([make_tag("D0"), make_tag("D14"), make_tag("D28")])
    dev = made_device(
        "plc", known.driver, known.wire, known.timing, known.tags, 0.5, turnaround=0.005
    )
    dev.record.count_exchanges(1, 0.0, 0.5)
    dev.record.exchanges = 1000
    assert not dev.learn_turnaround()


def test_a_measured_turnaround_is_expected_though_the_plan_stays() -> None:
    """The configured one (here none) stays: the pause after a broadcast depends on it alone."""
    dev = device([make_tag("D0")])
    blocks = dev.blocks
    dev.record.count_exchanges(1, 0.0, 0.060)
    dev.record.exchanges = 50
    before = dev.load
    assert not dev.learn_turnaround()
    assert dev.blocks is blocks
    assert (dev.turnaround.expected, dev.turnaround.configured) == (0.060, None)
    assert dev.load > before


def test_half_of_the_use_of_the_wire_is_forgotten_every_ten_seconds() -> None:
    dev = device([make_tag("D0")])
    dev.used(100.0, 96.0)
    assert dev.use == 2.0 + 100.0 / HALF_LIFE
    dev.used(110.0, 109.0)
    assert dev.use == pytest.approx(math.log2(3.0) + 110.0 / HALF_LIFE)
    dev.used(110.0, 110.0)
    assert dev.use == pytest.approx(math.log2(3.0) + 110.0 / HALF_LIFE)


@pytest.mark.parametrize(
    ("driver", "text", "proofs"),
    [
        (ModbusRtu(station=1, diagnostics=True), "holding:{}", 1),  # its token
        (Vigor(station=1), "D{}", 1),  # a read of nine words, which no block has
        (ModbusRtu(station=1), "holding:{}", 2),  # each of two equal reads for itself
    ],
)
def test_one_proof_is_for_all_blocks_where_its_reply_is_told_from_theirs(
    driver: AnyDriver, text: str, proofs: int
) -> None:
    tags = [make_tag(text.format(n), driver, every=2.0) for n in (0, 500)]
    dev = made_device("plc", driver, WIRE, driver.timing, tags)
    assert len(dev.blocks) == 2
    proof = dev.seconds(PROOF_COST) + dev.settled_after
    assert dev.load_of_proofs == pytest.approx(proofs * proof / 2.0)


def test_the_widest_block_gives_the_proof_when_a_narrow_one_was_read_last() -> None:
    """Single registers have one shape: many unanswered reads of them are told apart by it."""
    driver, narrow = ModbusRtu(station=1), Span("holding", 0, 1)
    tags = [make_tag(f"holding:{n}", driver) for n in (0, *range(100, 150, 5))]
    dev = made_device("plc", driver, WIRE, driver.timing, tags)
    dev.good_reads.note(narrow)
    dev.health.unclear(NoReply("silence"), narrow, 0.0, known=True)
    assert not dev.may_be_proven(0.0)
    dev.good_reads.note(Span("holding", 100, 46))
    dev.good_reads.note(narrow)
    assert dev.may_be_proven(0.0)
    dev.good_reads.replan()
    assert dev.may_be_proven(0.0)  # a resync may be under way: its reads stay the same
    dev.good_reads.note(narrow)
    assert not dev.may_be_proven(0.0)


@pytest.mark.parametrize(
    ("asked", "known", "proven"),
    [
        (Span("D", 0, 10), True, True),
        (Span("D", 100, 9), True, False),  # the shape of the proof
        (None, True, True),  # a resync
        (None, False, False),  # a proof, or a request of any shape
        (Span("D", 5, 1), False, False),  # a write
    ],
)
def test_a_proof_needs_a_shape_that_no_unanswered_request_has(
    asked: Span | None, known: bool, proven: bool
) -> None:
    dev = device(words(0, 20))
    dev.health.unclear(NoReply("silence"), asked, 0.0, known=known)
    dev.health.unclear(NoReply("silence"), Span("D", 0, 20), 1.0, known=True)
    assert dev.may_be_proven(0.0) is proven
    dev.health.answered(resynced=True)
    assert dev.may_be_proven(0.0)
