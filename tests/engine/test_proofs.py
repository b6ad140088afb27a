"""From the first extra reply on, the values of each read of the line wait for its proof."""

from dataclasses import replace
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.reply_shapes import QUIET, SHOWN, UNPROVEN, WARY_FOR
from gateway.engine.forecast import forecast
from gateway.engine.jobs.jobs import Poll, Probe, Resynced, Settle, Settled
from gateway.engine.jobs.poll_entry import OWED
from gateway.errors import Refusal, Refused
from gateway.planning.bad_addresses import RETRIES, BadRange
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.codec import Ack
from gateway.protocols.driver import EVERY_REQUEST, PROOF
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Quality, WriteRule
from tests.engine.rig import LOST, REPLIED, SECOND, SILENCE, Rig, link_device, tcp_device
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

REFUSED = Refused("it lacks the address", code="06", refusal=Refusal.ADDRESS)


def hear(rig: Rig, station: int = 1) -> None:
    """Brings a reply to no request."""
    extra: Any = Ack(station)
    rig.note(rig.engine.unmatched(rig.devices[station - 1], extra, rig.now, rig.time))


def doubtful(*devices: Device) -> Rig:
    """A line whose first device has answered twice. The reads before were judged."""
    rig = Rig(*devices)
    while any(device.state is not State.ONLINE for device in rig.devices):
        job = rig.transacted()
        rig.conclude(job, [7] * job.span.size if isinstance(job, Poll) else Resynced(EVERY_REQUEST))
    hear(rig)
    return rig


def read(rig: Rig, of: Device | None = None) -> Poll:
    """Performs the next poll of the device. Its values have no proof yet."""
    for _ in range(20):
        job = rig.transacted()
        if isinstance(job, Poll) and of in (None, job.device):
            rig.samples.clear()
            rig.conclude(job, [7] * job.span.size)
            return job
        rig.conclude(job, [7] * job.span.size if isinstance(job, Poll) else Resynced(EVERY_REQUEST))
    raise AssertionError("not polled")


def prove(rig: Rig, told_from: int = EVERY_REQUEST) -> None:
    probe = rig.next()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(told_from))


def good(rig: Rig) -> bool:
    return any(sample.quality is Quality.GOOD for sample in rig.samples)


def test_before_an_extra_reply_the_values_of_a_read_wait_for_nothing() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    read(rig)
    assert good(rig)


def test_after_it_they_wait_for_a_resync_and_have_the_time_of_their_reply() -> None:
    rig = doubtful()
    read(rig)
    at = rig.now
    assert not good(rig)
    prove(rig)
    assert good(rig)
    assert {sample.time for sample in rig.samples} == {int(at * SECOND)}


def test_the_other_devices_of_the_line_are_doubtful_too() -> None:
    rig = doubtful(link_device(), link_device(station=2))
    for device in rig.devices:
        read(rig, device)
        assert not good(rig)
        prove(rig)
        assert good(rig)


def test_a_resync_that_another_reply_may_answer_is_followed_by_silence() -> None:
    rig = doubtful()
    read(rig)
    prove(rig, told_from=1)
    assert not good(rig)
    settle = rig.next()
    assert isinstance(settle, Settle)
    assert settle.gap == rig.device.settled_after
    rig.conclude(settle, Settled(None))
    assert good(rig)


def test_a_minute_after_the_last_extra_reply_the_resync_is_enough() -> None:
    rig = doubtful()
    rig.now += SHOWN
    read(rig)
    assert not good(rig)
    prove(rig, told_from=1)
    assert good(rig)


def test_where_the_resync_may_be_answered_by_the_own_reply_it_is_sent_again_in_silence() -> None:
    rig = doubtful()
    read(rig)
    prove(rig, told_from=0)
    settle = rig.next()
    assert isinstance(settle, Settle)
    assert settle.gap == rig.device.longest_reply
    rig.conclude(settle, Settled(None))
    assert not good(rig)
    prove(rig, told_from=0)
    assert good(rig)


@pytest.mark.parametrize("when", ["before its resync", "during it", "in the silence after it"])
def test_an_extra_reply_ends_a_read_that_waits(when: str) -> None:
    rig = doubtful()
    job = read(rig)
    if when == "before its resync":
        hear(rig)
    probe = rig.next()
    assert isinstance(probe, Probe)
    if when == "during it":
        hear(rig)
    rig.conclude(probe, Resynced(1))
    if when == "in the silence after it":
        settle = rig.next()
        hear(rig)
        rig.conclude(settle, Settled(None))  # type: ignore[arg-type]
    again = read(rig)
    assert not good(rig)
    assert again.block is job.block


def test_the_own_reply_that_arrives_at_once_after_another_one_ends_the_read() -> None:
    """Both come in one piece: the extra one is known before the read is concluded."""
    rig = Rig()
    rig.bring(State.ONLINE)
    job = rig.transacted()
    assert isinstance(job, Poll)
    hear(rig)
    rig.conclude(job, [7] * job.span.size, replace(REPLIED, extra=1))
    prove(rig)
    assert not good(rig)


def test_bytes_before_the_resync_is_sent_end_the_read() -> None:
    """They may be the begin of its own reply: the rest arrives while the resync is sent."""
    rig = doubtful()
    read(rig)
    probe = rig.next()
    assert isinstance(probe, Probe)
    rig.note(rig.engine.received(b"\x02", rig.now, rig.time))
    rig.conclude(probe, Resynced(EVERY_REQUEST))
    assert not good(rig)


def test_an_extra_reply_that_is_no_frame_any_more_ends_the_read() -> None:
    rig = doubtful()
    read(rig)
    probe = rig.next()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(EVERY_REQUEST), replace(REPLIED, extra=1))
    assert not good(rig)


def test_a_read_with_an_extra_reply_that_is_no_frame_is_the_first_evidence() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    job = rig.transacted()
    assert isinstance(job, Poll)
    rig.conclude(job, [7] * job.span.size, replace(REPLIED, extra=1))
    assert rig.device.is_doubtful
    prove(rig)
    assert not good(rig)


@pytest.mark.parametrize("result", [SILENCE, REFUSED])
def test_a_resync_without_its_reply_proves_nothing(result: Exception) -> None:
    rig = doubtful()
    read(rig)
    probe = rig.next()
    assert isinstance(probe, Probe)
    rig.conclude(probe, result)  # type: ignore[arg-type]
    assert not good(rig)
    assert isinstance(rig.next(), Settle)


def test_a_wire_that_is_never_quiet_proves_nothing() -> None:
    rig = doubtful()
    read(rig)
    prove(rig, told_from=1)
    settle = rig.next()
    assert isinstance(settle, Settle)
    rig.conclude(settle, Settled(None, quiet=False))
    assert not good(rig)
    assert rig.device.state is State.ONLINE


def test_reads_without_a_proof_turn_the_tags_bad_after_the_retries() -> None:
    rig = doubtful(link_device(retries=1))
    for _ in range(2):
        read(rig)
        hear(rig)
        prove(rig)
    assert {(one.quality, one.detail) for one in rig.samples} == {(Quality.BAD, UNPROVEN)}


def test_after_many_proofs_in_vain_a_read_is_tried_once_in_each_interval() -> None:
    rig = doubtful(link_device(retries=2))
    every, at = rig.device.blocks[0].every, list[float]()
    while rig.now < 20 * every:
        read(rig)
        at.append(rig.now)
        hear(rig)
        prove(rig)
    first, later = (sum(begin < t / every < begin + 5 for t in at) for begin in (0, 15))
    assert first > 8
    assert later == 5
    read(rig)
    prove(rig)  # one proof ends it
    read(rig)
    hear(rig)
    prove(rig)
    failed = rig.now
    read(rig)
    assert rig.now - failed < every / 2


def late_read(rig: Rig, turnaround: float) -> None:
    """Performs the next poll; its reply has this turnaround."""
    while not isinstance(job := rig.transacted(), Poll):
        rig.conclude(job, Resynced(EVERY_REQUEST))
    rig.samples.clear()
    rig.conclude(job, [7] * job.span.size, replace(REPLIED, turnaround=turnaround))
    prove(rig)


@pytest.mark.parametrize("turnaround", [0.005, 0.12])
def test_a_reply_much_later_than_others_may_be_that_to_another_read(turnaround: float) -> None:
    """Its request or its own reply may be lost. Then none is one too many: a resync proves
    nothing."""
    rig = doubtful(link_device(retries=0))
    read(rig)
    prove(rig)
    late_read(rig, turnaround)
    assert good(rig) == (turnaround < 0.02)


def test_a_few_replies_that_another_master_delayed_make_no_late_one_usual() -> None:
    rig = doubtful(link_device(retries=0))
    for turnaround in [0.005] * 20 + [0.3] * 4:
        late_read(rig, turnaround)
    late_read(rig, 0.1)
    assert not good(rig)
    for _ in range(30):  # it is slower now
        late_read(rig, 0.1)
    assert good(rig)


def test_after_a_read_without_a_reply_the_next_reply_proves_nothing() -> None:
    """The station may be silent about that register, and the reply that of another master."""
    rig = doubtful(link_device(retries=0))
    [poll] = rig.engine.schedule.polls(rig.device)
    poll.ended(rig.now, False, None)
    poll.came_online(rig.now)  # other registers are read: the device was offline for a moment
    for _ in range(OWED):
        late_read(rig, 0.005)
        assert not good(rig)
    late_read(rig, 0.005)
    assert good(rig)
    poll.ended(rig.now, False, None)
    late_read(rig, 0.005)
    poll.ended(rig.now, False, None)  # silent again: it begins again
    for _ in range(OWED):
        late_read(rig, 0.005)
        assert not good(rig)


def test_another_plan_remembers_about_which_registers_the_station_was_silent() -> None:
    rig = doubtful(link_device(retries=0))
    [poll] = rig.engine.schedule.polls(rig.device)
    poll.ended(rig.now, False, None)
    rig.engine.schedule.replace(poll, [poll.block], rig.now)
    rig.engine.schedule.plan(rig.device, rig.now)
    [again] = rig.engine.schedule.polls(rig.device)
    assert again is not poll
    assert again.reads.owed == OWED


def test_an_address_that_returns_is_read_again_soon_although_its_first_replies_count_nothing() -> (
    None
):
    """Three of them wait for each other: each was five minutes after the one before."""
    rig = doubtful(link_device(retries=0))
    [poll] = rig.engine.schedule.polls(rig.device)
    span, bad = poll.block.span, rig.device.bad_addresses
    bad.bad[span] = BadRange(span, 0, "06", poll.block.tags, refusals=len(RETRIES))
    bad.clear = False
    assert rig.device.interval(poll.block) == RETRIES[-1]
    poll.reads.was_silent()
    late_read(rig, 0.005)
    begun = rig.now
    while not good(rig):
        late_read(rig, 0.005)
    assert rig.now - begun < (OWED + 1) * RETRIES[0]


@pytest.mark.parametrize("job", [Probe, Settle])
def test_a_port_that_is_lost_meanwhile_makes_no_value(job: type) -> None:
    rig = doubtful()
    read(rig)
    if job is Settle:
        prove(rig, told_from=1)
    current = rig.next()
    assert isinstance(current, Probe | Settle)
    assert type(current) is job
    rig.conclude(current, LOST)
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    rig.note(rig.engine.opened(rig.now))
    assert not good(rig)
    read(rig)
    prove(rig)
    assert good(rig)


def test_the_line_is_trusted_after_ten_minutes_without_an_extra_reply() -> None:
    rig = doubtful()
    rig.now += WARY_FOR - 1
    read(rig)
    assert not good(rig)
    prove(rig)
    assert rig.device.is_doubtful
    rig.now += 2
    read(rig)
    assert good(rig)
    assert not rig.device.is_doubtful


def test_the_forecast_has_the_load_with_proofs() -> None:
    one = forecast("line", [link_device()], WIRE)
    assert one.load_proven > 1.5 * one.load


def test_numbered_replies_need_no_proof() -> None:
    rig = Rig(tcp_device())
    one = forecast("line", [rig.device], WIRE)
    assert one.load_proven == one.load
    assert not rig.device.is_doubtful


def of_blocks(driver: Any, *texts: str) -> Rig:
    """A doubtful device with a block for each of the texts, polled every second."""
    tags = [make_tag(text, driver, write=WriteRule()) for text in texts]
    rig = doubtful(made_device("plc1", driver, WIRE, replace(driver.timing, retries=1), tags))
    assert rig.device.shapes is not None
    rig.device.shapes.extra_arrived(rig.now)  # whatever the protocol
    while rig.device.health.needs_resync:
        rig.conclude(rig.transacted(), Resynced(EVERY_REQUEST))
    return rig


def reads(rig: Rig) -> tuple[int, Probe]:
    """Performs polls until a resync follows. Returns their number, and the resync."""
    rig.samples.clear()
    job = rig.transacted()
    for count in range(20):
        if isinstance(job, Probe):
            return count, job
        rig.conclude(job, [7] * job.span.size)  # type: ignore[union-attr]
        assert not good(rig)
        job = rig.next()  # type: ignore[assignment]
    raise AssertionError("no resync")


def rounds(rig: Rig, count: int, told_from: int = EVERY_REQUEST) -> list[int]:
    """Returns for each round how many reads its resync proved."""
    proven = []
    for _ in range(count):
        rig.now += 5.0  # all blocks are due
        number, probe = reads(rig)
        rig.conclude(probe, Resynced(told_from))
        proven.append(number)
        if isinstance(rig.engine._in_flight.continuation, Settle):  # no public entry shows it
            rig.conclude(rig.transacted(), Settled(None))
        read = {id(rig.engine.reader(rig.device, sample.tag)) for sample in rig.samples}
        assert len(read) == number
        assert good(rig)
    return proven


PLACES = [base + n for base in (0, 1000, 2000, 3000) for n in range(12)]
BLOCKS = ("D0", "D1000", "D2000", "D3000")


def test_one_resync_proves_more_and_more_reads() -> None:
    assert rounds(of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS), 3) == [1, 2, 4]


def test_a_read_is_proven_alone_where_a_reply_to_it_may_answer_the_resync() -> None:
    """Its registers allow no resync of a form that none of the reads has."""
    rig = of_blocks(ModbusRtu(station=1), "holding:10", "holding:500")
    assert rounds(rig, 3, told_from=1) == [1, 1, 1]


def test_a_read_of_a_form_of_its_own_proves_several_in_silence() -> None:
    """Another master may ask for this form, too."""
    rig = of_blocks(ModbusRtu(station=1), *(f"holding:{n}" for n in PLACES))
    rounds(rig, 1)
    rig.now += 10.0
    count, probe = reads(rig)
    assert (count, probe.token) == (2, PROOF)
    rig.conclude(probe, Resynced(EVERY_REQUEST))
    assert not good(rig)
    assert isinstance(rig.next(), Settle)


@pytest.mark.parametrize("how", ["extra reply", "no reply", "resync without a reply"])
def test_all_reads_that_wait_are_read_again_and_the_next_is_proven_alone(how: str) -> None:
    rig = of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS)
    rounds(rig, 2)
    rig.now += 10.0
    job = rig.transacted()
    assert isinstance(job, Poll)
    rig.samples.clear()
    rig.conclude(job, [7] * job.span.size)
    second = rig.next()
    assert isinstance(second, Poll)
    if how == "no reply":
        rig.fail(second)
    else:
        if how == "extra reply":
            hear(rig)
        rig.conclude(second, [7] * second.span.size)
        probe = reads(rig)[1]
        if how == "extra reply":
            rig.conclude(probe, Resynced(EVERY_REQUEST))
        else:
            rig.fail(probe)
    assert not good(rig)
    while rig.device.health.needs_resync:
        rig.conclude(rig.transacted(), Resynced(EVERY_REQUEST))
    assert reads(rig)[0] == 1


def test_reads_that_follow_a_doubtful_one_wait_with_it_on_a_line_without_doubt() -> None:
    """They were good at once, and the first one waited for ever, or replaced newer values."""
    rig = of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS)
    rounds(rig, 2)
    assert rig.device.shapes is not None
    rig.device.shapes.quiet = QUIET  # ten minutes later
    rig.now += 10.0
    job = rig.transacted()
    assert isinstance(job, Poll)
    rig.samples.clear()
    rig.conclude(job, [7] * job.span.size, replace(REPLIED, doubtful=True))
    number, probe = reads(rig)
    assert number > 0
    rig.conclude(probe, Resynced(EVERY_REQUEST))
    assert len({id(rig.engine.reader(rig.device, one.tag)) for one in rig.samples}) == 1 + number


def test_a_refused_read_among_them_does_not_end_the_proof() -> None:
    rig = of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS)
    rounds(rig, 2)
    rig.now += 10.0
    read(rig)
    rig.conclude(rig.next(), REFUSED)  # type: ignore[arg-type]
    probe = rig.next()
    assert isinstance(probe, Poll | Probe)
    assert rig.device.health.needs_resync


def test_a_write_waits_for_no_other_read() -> None:
    rig = of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS)
    rounds(rig, 2)
    rig.now += 10.0
    job = rig.transacted()
    assert isinstance(job, Poll)
    rig.write("D1000")
    rig.conclude(job, [7] * job.span.size)
    assert isinstance(rig.next(), Probe)


def test_a_read_that_waits_is_not_read_again_before_its_proof() -> None:
    """A client that waits for a newer read gets the next one."""
    rig = of_blocks(ComputerLink(station=1, monitor=False), *BLOCKS)
    rounds(rig, 3)
    rig.now += 10.0
    first = rig.transacted()
    assert isinstance(first, Poll)
    rig.engine.expedite(rig.device, first.block.tags[0])
    rig.samples.clear()
    rig.conclude(first, [7] * first.span.size)
    blocks = [first.block]
    while isinstance(job := rig.next(), Poll):
        rig.conclude(job, [7] * job.span.size)
        blocks.append(job.block)
    assert len(set(blocks)) == len(blocks) == 4
    rig.conclude(job, Resynced(EVERY_REQUEST))  # type: ignore[arg-type]
    assert good(rig)
    again = rig.transacted()
    assert isinstance(again, Poll)
    assert again.block is first.block


@pytest.mark.parametrize("waits", [True, False])
def test_a_read_of_an_old_plan_makes_no_value(waits: bool) -> None:
    """No poll would know its age, so it would stay good for ever."""
    rig = doubtful() if waits else Rig()
    if waits:
        read(rig)
    else:
        rig.bring(State.ONLINE)
        job = rig.transacted()
    rig.engine.schedule.plan(rig.device, rig.now)
    if waits:
        prove(rig)
    else:
        rig.conclude(job, [7] * job.span.size)  # type: ignore[union-attr]
    assert not good(rig)


def test_a_device_that_refuses_the_read_of_a_form_of_its_own_is_asked_for_others() -> None:
    """A Vigor PLC of an old make refuses M0: each refusal costs more than half a second."""
    rig = of_blocks(ModbusRtu(station=1), *(f"holding:{n}" for n in range(12)))
    rig.now += 10.0
    probe = reads(rig)[1]
    assert probe.token == PROOF
    rig.conclude(probe, REFUSED)
    rig.conclude(rig.transacted(), Settled(None))
    rig.conclude(rig.transacted(), Resynced(1))
    for after, proof in ((0.0, False), (WARY_FOR, True)):
        rig.now += after
        for device in rig.devices:
            assert device.shapes is not None
            device.shapes.extra_arrived(rig.now)
        probe = reads(rig)[1]
        assert (probe.token == PROOF) is proof
        rig.conclude(probe, Resynced(1))
        rig.conclude(rig.transacted(), Settled(None))
        rig.now += 10.0
