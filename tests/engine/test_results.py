"""Results of polls and probes: what follows for the values, the plan, the log and the record."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from gateway.engine.device.device import HALF_LIFE, SILENT_SHARE
from gateway.engine.device.health import State
from gateway.engine.device.probe_pace import PAUSE_LONGEST
from gateway.engine.device.reply_shapes import QUIET
from gateway.engine.device.turnaround import LEARN_EVERY
from gateway.engine.jobs.jobs import (
    Idle,
    Poll,
    Probe,
    Reopen,
    Resynced,
    Settle,
    Settled,
    Traffic,
)
from gateway.engine.jobs.requests import Write
from gateway.engine.results.busy_devices import FIRST
from gateway.engine.results.poll_rules import BUSY_PAUSE
from gateway.engine.schedule.in_flight import MOST_CHARGED
from gateway.errors import DeviceError, Evidence, Garbled, Refusal, Refused, Unsteady
from gateway.planning.bad_addresses import RETRIES, SILENT, SPLIT_FIRST
from gateway.planning.planner import plan
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Quality, Reason
from tests.engine.rig import REPLIED, SILENCE, Rig, link_device, tcp_device
from tests.sim.bench import WIRE
from tests.sim.plant import device, made_device, make_tag

UNITS = [1, 2, 3, 4, 5, 6]
ADDRESS = Refused("no such address", code="06", refusal=Refusal.ADDRESS)
BUSY = Refused("busy", code="05", refusal=Refusal.BUSY)
DAMAGED = Refused("sum check", code="02", refusal=Refusal.DAMAGED)
OTHER = Refused("not allowed", code="10")


def online(retries: int = 1) -> Rig:
    rig = Rig(link_device(retries=retries))
    rig.bring(State.ONLINE)
    rig.logged.clear()
    return rig


def polled(rig: Rig) -> Poll:
    job = rig.transacted()
    assert isinstance(job, Poll)
    return job


def events(rig: Rig) -> list[str]:
    found = [event.event for event in rig.logged]
    rig.logged.clear()
    return found


# Good reads


def test_a_good_read_makes_a_sample_of_each_tag_with_the_time_of_its_reply() -> None:
    rig = online()
    rig.conclude(polled(rig), UNITS)
    assert [(s.tag.text, s.value, s.time) for s in rig.samples] == [
        (f"D{n}", n + 1, rig.time) for n in range(6)
    ]


def test_good_reads_are_counted_with_their_mean_and_worst_gap() -> None:
    rig = online()
    for took in (0.02, 0.02, 0.52):
        poll = polled(rig)
        rig.conclude(poll, UNITS, took=took)
    reads = rig.entry(poll).reads
    assert reads.count == 3
    assert reads.worst_gap > reads.mean_gap > 0.9


def test_a_device_that_comes_online_is_logged_and_its_polls_are_due_at_once() -> None:
    rig = Rig()
    rig.conclude(rig.transacted(), Resynced(1))
    assert events(rig) == ["device online"]
    assert rig.entry(polled(rig)).due == rig.now


def test_a_good_poll_after_a_late_reply_ends_the_failures() -> None:
    """Otherwise a device that is slow now and then would go offline though most polls are read."""
    rig = online()
    for _ in range(5):
        rig.fail(polled(rig), late=0.1)
        assert rig.device.state == "failing"
        rig.conclude(polled(rig), UNITS)
        assert rig.device.state == "online"
        assert rig.device.health.consecutive_failures == 0
        assert rig.device.diagnosis() == ""


# Refusals


@pytest.mark.parametrize("refusal", [ADDRESS, BUSY, DAMAGED, OTHER])
def test_each_refusal_is_counted_and_shows_that_the_device_is_online(refusal: Refused) -> None:
    rig = online()
    rig.fail(polled(rig), late=0.1)
    rig.conclude(polled(rig), refusal, REPLIED)
    assert rig.device.record.refusals == {refusal.code: 1}
    assert rig.device.state is State.ONLINE


def test_a_busy_device_is_polled_again_after_growing_pauses() -> None:
    rig = online(retries=2)
    pauses = list[float]()
    rig.conclude(polled(rig), BUSY, REPLIED)
    for _ in range(2):
        ended, poll = rig.now, polled(rig)
        pauses.append(rig.now - ended)
        if len(pauses) < 2:
            rig.conclude(poll, BUSY, REPLIED)
    assert pauses == pytest.approx([BUSY_PAUSE, FIRST])
    assert rig.samples == []
    rig.conclude(poll, BUSY, REPLIED)
    assert {sample.reason for sample in rig.samples} == {Reason.REFUSED}


def test_a_request_that_arrived_damaged_is_sent_again_at_once() -> None:
    rig = online(retries=2)
    poll = polled(rig)
    for _ in range(2):
        rig.conclude(poll, DAMAGED, REPLIED)
        block, poll = poll.block, polled(rig)
        assert poll.block is block
    rig.conclude(poll, DAMAGED, REPLIED)
    assert {sample.reason for sample in rig.samples} == {Reason.REFUSED}


def test_any_other_refusal_that_comes_again_halves_the_block() -> None:
    rig = online(retries=2)
    poll = polled(rig)
    for _ in range(2):
        rig.conclude(poll, OTHER, REPLIED)
        rig.now += QUIET
        assert polled(rig) is poll
    rig.conclude(poll, OTHER, REPLIED)
    assert polled(rig).block.span.size == 3
    assert rig.samples == []


@pytest.mark.parametrize("refusal", [BUSY, DAMAGED])
def test_a_busy_device_and_damaged_requests_start_no_search(refusal: Refused) -> None:
    rig = online(retries=1)
    for _ in range(12):
        poll = polled(rig)
        assert poll.block.span.size == 6
        rig.conclude(poll, refusal, REPLIED)
    assert rig.device.bad_addresses.clear


def serve(
    rig: Rig,
    until: float,
    silent: Callable[[Span], bool] = lambda _: False,
    error: DeviceError = SILENCE,
) -> None:
    """Serves the device, which replies to all requests but those for silent spans."""
    while rig.now < until:
        job = rig.next()
        match job:
            case Idle():
                rig.now = min(until, job.until)
            case Probe():
                rig.conclude(job, Resynced(9))
            case Poll(block=block) if silent(block.span):
                rig.fail(job, error=error)
            case Poll(span=span):
                start, size = span.start, span.size
                rig.conclude(job, (UNITS * 200)[start : start + size])


def good_now(rig: Rig) -> set[str]:
    last = {sample.tag.text: sample.quality for sample in rig.samples}
    return {text for text, quality in last.items() if quality is Quality.GOOD}


def test_an_address_about_which_the_device_is_silent_is_found_by_halves() -> None:
    rig = online(retries=2)
    serve(rig, 30.0, lambda span: span.start <= 2 < span.start + span.size)
    [bad] = rig.device.bad_addresses.bad.values()
    assert (bad.span.start, bad.span.size, bad.code) == (2, 1, SILENT)
    assert good_now(rig) == {"D0", "D1", "D3", "D4", "D5"}
    assert "device offline" not in events(rig)
    serve(rig, 400.0)
    assert rig.device.bad_addresses.clear
    assert [block.span.size for block in rig.device.blocks] == [6]


def test_an_address_whose_replies_were_damaged_for_long_is_back_soon() -> None:
    rig = online(retries=2)
    cut = Garbled("no whole frame", b"\x02", evidence=Evidence.TRUNCATED)
    serve(rig, 600.0, lambda span: span.start <= 2 < span.start + span.size, cut)
    [bad] = rig.device.bad_addresses.bad.values()
    assert (bad.span.start, bad.span.size, bad.how) == (2, 1, "no whole reply")
    serve(rig, 602.0 + PAUSE_LONGEST)
    assert len(good_now(rig)) == 6


@pytest.mark.parametrize("outage", [2.0, 8.0, 20.0])
def test_an_outage_of_one_block_leaves_no_bad_address_and_no_split(outage: float) -> None:
    rig = online(retries=2)
    serve(rig, outage, lambda _: True)
    serve(rig, 400.0)
    assert rig.device.bad_addresses.clear
    assert [block.span.size for block in rig.device.blocks] == [6]
    assert len(good_now(rig)) == 6


def test_a_device_that_goes_offline_starts_no_search() -> None:
    rig = online(retries=2)
    while rig.device.state is not State.OFFLINE:
        job = rig.transacted()
        assert isinstance(job, Poll | Probe)
        rig.fail(job)
    for _ in range(3):
        job = rig.transacted()
        assert isinstance(job, Probe)
        rig.fail(job)
    bad = rig.device.bad_addresses
    assert not [*bad.searches, *bad.silenced, *bad.cuts]


def test_a_block_too_long_for_the_device_is_split_and_tried_whole_again_much_later() -> None:
    rig = online(retries=1)
    serve(rig, 30.0, lambda span: span.size > 3)
    assert [block.span.size for block in rig.device.blocks] == [3, 3]
    assert len(good_now(rig)) == 6
    assert not rig.device.bad_addresses.bad
    serve(rig, SPLIT_FIRST)
    assert len(rig.device.blocks) == 2
    serve(rig, SPLIT_FIRST + 60.0)
    assert [block.span.size for block in rig.device.blocks] == [6]
    assert rig.device.bad_addresses.clear


def test_many_silent_addresses_are_tried_in_a_hundredth_of_the_time() -> None:
    dev = link_device()
    for n in range(6):
        block = plan([dev.tags[n]], dev.driver, dev.seconds)[0]
        for _ in range(4):
            dev.bad_addresses.refused(block, 0, SILENT)
    assert dev.interval(block) == pytest.approx(6 * dev.longest_reply / SILENT_SHARE)
    dev.bad_addresses.refused(block, 0, "06")
    assert dev.interval(block) == RETRIES[-1]


def test_a_bad_address_is_found_by_halves_and_the_others_are_planned_again() -> None:
    rig = online()
    for _ in range(20):
        job = rig.next()
        if isinstance(job, Idle):
            break
        assert isinstance(job, Poll)
        span = job.block.span
        if span.start <= 2 < span.start + span.size:
            rig.conclude(job, ADDRESS, REPLIED)
        else:
            rig.conclude(job, UNITS[span.start : span.start + span.size])
    assert events(rig) == ["address refused"]
    [bad] = rig.device.bad_addresses.bad
    assert (bad.start, bad.size) == (2, 1)
    found = {sample.tag.text: sample.quality for sample in rig.samples}
    assert found.pop("D2") is Quality.BAD
    assert set(found.values()) == {Quality.GOOD}
    assert len(rig.device.blocks) == 3
    rig.now += 400.0
    while rig.device.bad_addresses.bad:
        job = polled(rig)
        rig.conclude(job, UNITS[: job.span.size])
    assert events(rig) == ["address returned"]
    assert len(rig.device.blocks) == 1


def test_a_block_that_was_read_before_is_asked_once_more_before_it_is_halved() -> None:
    """Noise can turn the request into one for another address."""
    rig = online()
    poll = polled(rig)
    rig.conclude(poll, UNITS)
    assert polled(rig) is poll
    rig.conclude(poll, ADDRESS, REPLIED)
    rig.now += QUIET
    assert rig.next() is poll
    rig.conclude(poll, ADDRESS, REPLIED)
    assert polled(rig).block.span.size < poll.block.span.size


def test_unsteady_reads_are_repeated_before_the_tags_turn_bad() -> None:
    rig = online()
    poll = polled(rig)
    rig.conclude(poll, Unsteady("differ"), REPLIED)
    assert rig.samples == []
    again = polled(rig)
    assert again.block is poll.block
    rig.conclude(again, Unsteady("differ"), REPLIED)
    assert {(s.reason, s.detail) for s in rig.samples} == {(Reason.GARBLED, "differ")}
    assert rig.device.state is State.ONLINE


# Unclear ends


@pytest.mark.parametrize(
    ("error", "reason"),
    [(SILENCE, Reason.NO_REPLY), (Garbled("noise"), Reason.GARBLED)],
)
def test_after_the_last_retry_the_device_goes_offline_with_bad_values(
    error: DeviceError, reason: Reason
) -> None:
    rig = online(retries=0)
    job = polled(rig)
    rig.conclude(job, error)
    rig.conclude(rig.transacted(), Settled(None))
    assert rig.device.state is State.OFFLINE
    assert {sample.reason for sample in rig.samples} == {reason}
    assert {sample.detail for sample in rig.samples} == {rig.device.diagnosis()}
    assert events(rig) == ["transaction failed", "device offline"]
    assert sum(rig.device.record.failures.values()) == 1


def test_a_failed_probe_of_an_offline_device_is_no_second_warning() -> None:
    rig = Rig()
    rig.bring(State.OFFLINE)
    assert events(rig) == ["transaction failed", "device offline"]
    rig.fail(rig.transacted())
    assert events(rig) == ["transaction failed"]


def test_an_unclear_end_forgets_the_monitor_list() -> None:
    rig = online()
    rig.device.monitor.must_register((rig.device.blocks[0].span,))
    rig.conclude(polled(rig), SILENCE)
    assert rig.device.monitor.registered == ()


def test_a_plc_that_is_silent_about_its_list_is_read_without_one() -> None:
    """Each registration cost a time-out, for ever: only a refusal ended it."""
    driver = ComputerLink(station=1, monitor=True)
    timing = replace(driver.timing, retries=1)
    tags = [make_tag(f"D{n}", driver) for n in range(0, 400, 100)]
    rig = Rig(made_device("plc", driver, WIRE, timing, tags))
    rig.bring(State.ONLINE)
    for _ in range(60):
        match job := rig.transacted():
            case Poll() if rig.entry(job).block.listed:
                rig.fail(job)
            case Poll():
                rig.conclude(job, [0] * job.span.size)
            case _:
                rig.conclude(job, Resynced(1))
    assert not any(block.listed for block in rig.device.blocks)
    assert events(rig).count("monitor list refused") == 1
    renewed = rig.device.successor(rig.device.settings, rig.device.bad_addresses.known())
    renewed.plan()
    assert not any(block.listed for block in renewed.blocks)


def test_the_line_waits_for_late_replies_of_online_devices_alone() -> None:
    rig = Rig()
    guards = list[float]()
    for _ in range(2):
        rig.conclude(rig.transacted(), SILENCE)
        settle = rig.next()
        assert isinstance(settle, Settle)
        guards.append(settle.guard)
        rig.conclude(settle, Settled(None))
    assert guards == [rig.device.settings.late_guard, 0.0]


def test_after_damaged_replies_the_line_waits_for_the_late_reply_to_a_write_alone() -> None:
    rig = online(retries=5)
    rig.fail(rig.transacted(), error=Garbled("noise"))
    guards = list[float]()
    for kind in (Poll, Write):
        if kind is Write:
            rig.write("D0")
        while not isinstance(job := rig.transacted(), kind):
            rig.conclude(job, Resynced(1) if isinstance(job, Probe) else [0] * 6)
        rig.conclude(job, SILENCE)
        settle = rig.next()
        assert isinstance(settle, Settle)
        guards.append(settle.guard)
        rig.conclude(settle, Settled(None))
    assert guards == [0.0, rig.device.settings.late_guard]


def test_a_late_reply_is_counted_and_diagnosed_as_slow() -> None:
    rig = online()
    rig.fail(polled(rig), late=0.1)
    assert rig.device.record.late == 1
    assert "raise reply_timeout" in rig.device.diagnosis()
    assert "it took 0.60 s, reply_timeout is 0.5 s" in rig.device.diagnosis()
    assert isinstance(rig.next(), Poll)  # no resync is needed


def test_a_late_reply_completes_no_resync_while_older_requests_are_outstanding() -> None:
    rig = online(retries=3)
    rig.fail(polled(rig))
    rig.fail(rig.transacted(), late=0.1)
    assert rig.device.health.needs_resync


def test_a_poll_of_several_at_once_without_a_reply_turns_bad_after_its_own_retries() -> None:
    rig = Rig(tcp_device(2))
    rig.bring(State.ONLINE)
    silent = rig.device.tags[0]
    for _ in range(6):
        job = rig.transacted()
        if not isinstance(job, Poll):
            rig.conclude(job, Resynced(9))
            continue
        for poll in (job, *rig.engine.alongside(job, rig.now)):
            rig.conclude(poll, SILENCE if silent in poll.block.tags else [7])
        if isinstance(settle := rig.next(), Settle):
            rig.conclude(settle, Settled(None))
    bad = [sample for sample in rig.samples if sample.quality is Quality.BAD]
    assert bad
    assert {sample.tag for sample in bad} == {silent}
    assert rig.device.health.online


def test_while_the_process_stood_still_no_device_used_the_wire() -> None:
    """It would be polled behind all others for minutes, where they are late."""
    rig = Rig(link_device(), link_device(station=2))
    rig.bring(State.ONLINE)
    job = rig.transacted()
    rig.conclude(job, Resynced(9) if isinstance(job, Probe) else [7] * 6, took=3600.0)
    while not isinstance(job := rig.transacted(), Poll):
        rig.conclude(job, Resynced(9))
    rig.conclude(job, [7] * job.span.size, took=3600.0)
    assert job.device.use <= math.log2(2 * MOST_CHARGED) + rig.now / HALF_LIFE


def test_replies_of_another_station_make_no_address_bad() -> None:
    """After three minutes of them a block stayed bad for 300 s."""
    rig = online(retries=1)
    foreign = Garbled("another station spoke", evidence=Evidence.STATION)
    while rig.now < 60.0:
        job = rig.next()
        match job:
            case Idle():
                rig.now = job.until
            case Probe():
                rig.conclude(job, Resynced(9))
            case _:
                assert isinstance(job, Poll | Settle)
                rig.conclude(job, foreign if isinstance(job, Poll) else Settled(None))
    assert rig.device.bad_addresses.clear
    assert good_now(rig) == set()


# Learning


def test_a_measured_turnaround_that_changes_the_optimum_plans_again_and_is_logged() -> None:
    tags = [make_tag(text) for text in ("D0", "D14", "D28", "D42")]
    rig = Rig(device(tags))  # planned with the protocol's 5 ms
    rig.bring(State.ONLINE)
    rig.logged.clear()
    assert len(rig.device.blocks) == 4
    slow = Traffic(sent=17, heard=20, exchanges=1, turnaround=0.06)
    for _ in range(LEARN_EVERY):
        poll = polled(rig)
        rig.conclude(poll, [7] * poll.span.size, slow)
    assert events(rig) == ["plan updated"]
    assert len(rig.device.blocks) < 4
    assert {poll.block for poll in rig.engine.schedule.polls(rig.device)} == set(rig.device.blocks)


def test_a_silent_address_is_found_also_where_one_failure_makes_the_device_offline() -> None:
    """With `retries: 0` the device went offline at every try, and was never read."""
    rig = online(retries=0)
    serve(rig, 100.0, lambda span: span.start <= 2 < span.start + span.size)
    [bad] = rig.device.bad_addresses.bad.values()
    assert (bad.span.start, bad.span.size, bad.code) == (2, 1, SILENT)
    assert good_now(rig) == {"D0", "D1", "D3", "D4", "D5"}
    assert events(rig).count("device offline") == 1


def test_a_device_that_died_twice_at_one_block_has_no_bad_address() -> None:
    rig = online(retries=0)
    for begin in (20.0, 100.0):
        serve(rig, begin)
        while rig.device.state is not State.OFFLINE:
            job = rig.next()
            if isinstance(job, Idle):
                rig.now = job.until
            else:
                assert not isinstance(job, Reopen)
                rig.fail(job)
    serve(rig, 200.0)
    assert rig.device.bad_addresses.clear
    assert len(good_now(rig)) == 6


def test_two_silent_blocks_are_found_where_one_failure_makes_the_device_offline() -> None:
    """They took turns: each made the device offline, and the search for the other was dropped."""
    driver = ComputerLink(station=1, monitor=False)
    timing = replace(driver.timing, retries=0)
    starts = (0, 500, 1000)  # three blocks of two words
    tags = [make_tag(f"D{start + n}", driver) for start in starts for n in (0, 1)]
    rig = Rig(made_device("plc1", driver, WIRE, timing, tags))
    bad = {1, 501}
    serve(rig, 200.0, lambda span: any(span.start <= n < span.start + span.size for n in bad))
    assert {span.start for span in rig.device.bad_addresses.bad} == bad
    assert good_now(rig) == {"D0", "D500", "D1000", "D1001"}
    assert events(rig).count("device offline") == 2


def test_the_line_is_quiet_before_a_probe_that_may_have_an_older_reply_is_repeated() -> None:
    """A device server that stays behind passed on old requests, one by one, also after a wait."""
    rig = online(retries=3)
    for _ in range(2):
        job = rig.transacted()
        rig.fail(job)
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(0))
    settle = rig.transacted()
    assert isinstance(settle, Settle)
    assert settle.gap == rig.device.longest_reply
    assert settle.guard == 3 * rig.device.longest_reply
    rig.conclude(settle, Settled(None, quiet=False))
    assert rig.device.health.needs_resync
    assert "never quiet" in str(rig.device.health.trouble)


def test_the_probe_of_a_late_station_is_repeated_when_its_form_is_old_enough() -> None:
    driver = ModbusRtu(station=1)
    tags = [make_tag(f"holding:{n}", driver, device="plc") for n in range(3)]
    rig = Rig(made_device("plc", driver, WIRE, driver.timing, tags))
    rig.bring(State.ONLINE)
    for _ in range(2):
        rig.fail(rig.transacted())
    probe = rig.transacted()
    assert rig.device.shapes is not None
    for size in (1, 2, 3):
        shape = driver.reply_shape(Span("holding", 0, size))
        rig.device.shapes.also_sent(shape, rig.now)
        rig.device.health.unanswered.seconds.append(shape)
    rig.device.health.probes.replied_behind(rig.now, 1.0)
    rig.conclude(probe, Resynced(0))
    settle = rig.transacted()
    assert isinstance(settle, Settle)
    rig.conclude(settle, Settled(None, quiet=True))
    longer = rig.transacted()
    assert isinstance(longer, Settle)
    assert longer.gap == 2.0
    rig.now += longer.gap
    rig.conclude(longer, Settled(None, quiet=True))
    again = rig.transacted()
    assert isinstance(again, Probe)
    assert again.again
