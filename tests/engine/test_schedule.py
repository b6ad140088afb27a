"""Each sentence of the class docstring is a test; in any order of calls no poll is lost."""

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.probe_pace import PAUSE_FIRST, PAUSE_LONGEST, PROBE_PAUSE
from gateway.engine.jobs.jobs import Idle, Probe
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.jobs.request_queue import MOST_WAITING
from gateway.engine.jobs.requests import WRITE_EXPIRY, Write
from gateway.engine.schedule.probes import (
    OFFLINE_SHARE,
    ONE_OFFLINE,
    PATIENT_AFTER,
    SHORTEST,
    UNKNOWN,
    USUAL,
    probe_seconds,
    short_timeout,
)
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import NoReply
from gateway.planning.bad_addresses import RETRIES
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.tags import WriteRule
from tests.engine.rig import weighing_machine
from tests.sim.bench import WIRE
from tests.sim.plant import device, made_device, make_tag


def online(*numbers: int, every: float = 1.0, station: int = 1) -> Device:
    """An online device, with one block of one word for each number."""
    found = device(
        [make_tag(f"D{n}", every=every, write=WriteRule()) for n in numbers], station=station
    )
    found.health.answered()
    return found


def write(device: Device, submitted: float = 0.0) -> Write:
    return Write(device, device.tags[0], [1], submitted)


def fail(device: Device) -> None:
    device.health.unclear(NoReply("silence"), None, 0.0)


def polled(schedule: Schedule, now: float) -> PollEntry:
    job = schedule.next(now)
    assert isinstance(job, PollEntry)
    schedule.polled(job, now)
    return job


def test_requests_go_first() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    mine = write(dev)
    schedule.requests.submit(mine)
    assert schedule.next(0.0) is mine
    assert isinstance(schedule.next(0.0), PollEntry)


def test_but_not_twice_in_a_row_while_a_poll_is_due() -> None:
    dev = online(0, 1000)
    schedule = Schedule([dev], 0.0)
    writes = [write(dev) for _ in range(4)]
    for one in writes:
        schedule.requests.submit(one)
    jobs: list[Any] = []
    for _ in range(6):
        jobs.append(schedule.next(0.0))
        if isinstance(jobs[-1], PollEntry):
            schedule.polled(jobs[-1], 0.0)
    assert [job for job in jobs if isinstance(job, Write)] == writes
    assert [isinstance(job, PollEntry) for job in jobs] == [False, True, False, True, False, False]


def test_a_write_does_not_wait_for_replaced_polls() -> None:
    """The second write goes at once when the poll that was due has been replaced meanwhile."""
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    schedule.requests.submit(write(dev))
    schedule.requests.submit(second := write(dev))
    assert isinstance(schedule.next(0.0), Write)
    schedule.plan(dev, 0.0)
    schedule.polls(dev)[0].live = False
    assert schedule.next(0.0) is second


def test_polls_go_by_earliest_deadline_over_all_devices() -> None:
    slow, fast = online(0, every=5.0), online(0, every=0.5, station=2)
    schedule = Schedule([slow, fast], 0.0)
    assert polled(schedule, 0.0).device is fast
    assert polled(schedule, 4.9).device is fast  # due since 0.5, until 1.0
    assert polled(schedule, 4.9).device is slow


def test_an_expedited_poll_goes_before_other_polls() -> None:
    dev = online(0, 1000, 2000)
    schedule = Schedule([dev], 0.0)
    expedited = schedule.polls(dev)[2]
    schedule.expedite(expedited)
    schedule.expedite(expedited)
    assert polled(schedule, 0.0) is expedited
    assert len({polled(schedule, 0.0), polled(schedule, 0.0)}) == 2
    assert schedule.next(0.0) == Idle(1.0)


def test_but_not_twice_in_a_row_while_one_is_due() -> None:
    dev = online(0, 1000)
    schedule = Schedule([dev], 0.0)
    expedited, other = schedule.polls(dev)
    asked = []
    for _ in range(4):
        schedule.expedite(expedited)
        asked.append(polled(schedule, 0.0))
    assert asked == [expedited, other, expedited, expedited]


def questions(schedule: Schedule, asked: Sequence[PollEntry], until: float) -> dict[PollEntry, int]:
    """Clients ask for these polls all the time; a poll takes its expected time."""
    now, sent = 0.0, dict[PollEntry, int]()
    while now < until:
        for poll in asked:
            schedule.expedite(poll, on_demand=True)
        match schedule.next(now):
            case PollEntry() as poll:
                now += poll.device.seconds(poll.block.cost)
                schedule.polled(poll, now)
                sent[poll] = sent.get(poll, 0) + 1
            case Idle(then):
                now = then
    return sent


def fast_and_slow(every: float) -> Device:
    """A device with a poll of one word every 100 ms, and two long ones."""
    numbers = [n for start in (1000, 2000) for n in range(start, start + 64)]
    slow = [make_tag(f"D{n}", every=every) for n in numbers]
    found = device([make_tag("D0", every=0.1), *slow])
    found.health.answered()
    return found


def test_questions_of_clients_do_not_hold_up_a_fast_poll() -> None:
    schedule = Schedule([dev := fast_and_slow(every=60.0)], 0.0)
    fast, *asked = schedule.polls(dev)
    assert 0.1 < dev.seconds(asked[0].block.cost) < 0.4
    sent = questions(schedule, asked, 60.0)
    assert sent[fast] > 0.8 * 600
    share = sum(sent[poll] * dev.seconds(poll.block.cost) for poll in asked) / 60.0
    assert share > 0.2  # the clients get theirs


def test_a_poll_after_a_write_does_not_wait_with_questions() -> None:
    dev = online(0, 1000, 2000, every=10.0)
    schedule = Schedule([dev], 0.0)
    first, second, written = (polled(schedule, 0.0) for _ in range(3))
    for poll in (first, second, written):
        schedule.expedite(poll, on_demand=True)
    assert polled(schedule, 1.0) is first
    schedule.expedite(written)
    schedule.expedite(written, on_demand=True)
    assert polled(schedule, 3.0) is written
    assert polled(schedule, 3.0) is second


def test_questions_that_hold_up_no_poll_get_the_rest_of_the_wire() -> None:
    dev = online(0, 1000, every=1.0)
    schedule = Schedule([dev], 0.0)
    _, asked = schedule.polls(dev)
    took = dev.seconds(asked.block.cost)
    assert questions(schedule, [asked], 10.0)[asked] * took > 0.8 * 10.0


def test_while_the_process_stood_still_no_question_is_charged() -> None:
    """After an hour others waited for three more."""
    dev = online(0, 1000, every=0.01)
    schedule = Schedule([dev], 0.0)
    _, asked = schedule.polls(dev)
    now, sent = 0.0, list[float]()
    while now < 3700.0:
        schedule.expedite(asked, on_demand=True)
        poll = polled(schedule, now)
        now += 3600.0 if poll is asked and not sent else 0.1
        schedule.polled(poll, now)
        sent += [now] if poll is asked else []
    assert len(sent) > 100


def test_a_poll_that_clients_ask_for_is_not_polled_less_than_without_them() -> None:
    schedule = Schedule([dev := fast_and_slow(every=1.0)], 0.0)
    _, *asked = schedule.polls(dev)
    sent = questions(schedule, asked, 60.0)
    assert min(sent[poll] for poll in asked) > 50


def test_a_poll_that_clients_ask_for_does_not_wait_for_ever_behind_polls_after_writes() -> None:
    """The line is asked for more than it carries, and a tag is written all the time."""
    dev = online(0, 1000, 2000, every=0.01)
    schedule = Schedule([dev], 0.0)
    written, asked, other = schedule.polls(dev)
    now, sent = 0.0, Counter[PollEntry]()
    while now < 20.0:
        schedule.expedite(written)
        schedule.expedite(asked, on_demand=True)
        poll = polled(schedule, now)
        now += dev.seconds(poll.block.cost)
        schedule.polled(poll, now)
        sent[poll] += 1
    assert sent[asked] > 0.8 * sent[other]


def test_a_poll_expedited_while_it_is_in_flight_is_sent_once_more() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    poll = schedule.next(0.0)
    assert isinstance(poll, PollEntry)
    schedule.expedite(poll)
    schedule.polled(poll, 0.1)
    assert polled(schedule, 0.1) is poll
    assert schedule.next(0.1) == Idle(1.1)


def test_a_late_poll_is_done_once_not_once_per_missed_period() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    polled(schedule, 5.3)
    assert dev.record.overruns == 5
    assert schedule.next(5.3) == Idle(6.3)


def test_a_poll_that_is_a_little_late_keeps_its_phase() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    for period in range(10):
        polled(schedule, period + 0.4)
    assert schedule.next(9.5) == Idle(10.0)
    assert dev.record.overruns == 0


def test_a_device_that_needs_a_resync_is_probed_before_anything_else() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    fail(dev)
    for submitted in (False, True):
        if submitted:
            schedule.requests.submit(write(dev))
        job = schedule.next(0.0)
        assert isinstance(job, Probe)
        assert job.device is dev
    dev.health.answered()
    assert isinstance(schedule.next(0.0), Write)
    assert isinstance(schedule.next(0.0), PollEntry)


def test_a_write_does_not_wait_behind_one_for_a_device_that_has_just_failed() -> None:
    failing, well = online(0), online(0, station=2)
    schedule = Schedule([failing, well], 0.0)
    first, second, other = write(failing), write(failing), write(well)
    for one in (first, second, other):
        schedule.requests.submit(one)
    fail(failing)
    assert isinstance(schedule.next(0.0), Probe)
    schedule.failed(2.0, took=2.0)
    assert schedule.next(2.0) is other
    assert polled(schedule, 2.0).device is well
    assert isinstance(schedule.next(4.5), Probe)


def test_a_bad_poll_is_tried_again_within_a_minute_even_at_a_long_interval() -> None:
    dev = online(0, every=86_400.0)
    schedule = Schedule([dev], 0.0)
    job = schedule.next(0.0)
    assert isinstance(job, PollEntry)
    schedule.polled(job, 0.0)  # the device was busy, say: no value was read
    assert isinstance(schedule.next(PAUSE_LONGEST), PollEntry)


def test_a_bad_address_is_polled_rarely_but_keeps_its_short_deadline() -> None:
    dev = online(0)
    (poll,) = Schedule([dev], 0.0).polls(dev)
    assert not dev.bad_addresses.refused(poll.block, 0, "28")
    assert poll.every == RETRIES[0]
    assert poll.deadline == poll.due + 1.0


def test_an_expedited_poll_of_a_device_that_needs_a_resync_stays_expedited() -> None:
    dev = online(0, 1000)
    schedule = Schedule([dev], 0.0)
    expedited = schedule.polls(dev)[1]
    fail(dev)
    schedule.expedite(expedited)
    assert isinstance(schedule.next(0.0), Probe)
    dev.health.answered()
    assert schedule.next(0.0) is expedited


def test_a_starting_device_is_probed_at_once() -> None:
    dev = device([make_tag("D0")])
    schedule = Schedule([dev], 0.0)
    assert isinstance(schedule.next(0.0), Probe)
    dev.health.answered()
    schedule.came_online(dev, 0.1)
    assert isinstance(schedule.next(0.1), PollEntry)


def test_while_polls_of_others_are_due_starting_devices_get_half_of_the_time() -> None:
    healthy = online(0, every=0.01)
    starting = [device([make_tag("D0")], station=n) for n in range(2, 40)]
    schedule = Schedule([healthy, *starting], 0.0)
    now, probing = 0.0, 0.0
    while now < 30.0:
        match schedule.next(now):
            case Probe(found):
                now += 0.5
                probing += 0.5
                fail(found)
                schedule.failed(now, 0.5)
                schedule.went_offline(found, now, 0.5)
            case PollEntry() as poll:
                now += 0.02
                schedule.polled(poll, now)
    assert 0.4 <= probing / now <= 0.55


def test_a_device_that_fails_does_not_hold_up_the_others_twice_in_a_row() -> None:
    bad, healthy = online(0, every=0.1), online(0, every=5.0, station=2)
    schedule = Schedule([bad, healthy], 0.0)
    poll = schedule.next(0.0)
    assert isinstance(poll, PollEntry)
    assert poll.device is bad
    fail(bad)
    schedule.failed(1.0, 1.0)
    schedule.again(poll)
    assert polled(schedule, 1.0).device is healthy
    assert isinstance(schedule.next(1.0), Probe)


def test_meanwhile_a_device_that_is_left_alone_is_not_polled_in_its_place() -> None:
    failing, alone, other = online(0), online(0, station=2), online(0, station=3)
    schedule = Schedule([failing, alone, other], 0.0)
    fail(failing)
    schedule.failed(1.5, 1.0)
    jobs = [
        schedule.next(1.5, lambda one, now: now + 1.0 if one is alone else now) for _ in range(2)
    ]
    assert [job.device for job in jobs if not isinstance(job, Idle)] == [other, failing]


def test_an_offline_device_is_only_probed_at_growing_pauses() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    now, pauses = 0.0, []
    fail(dev)
    for _ in range(12):
        schedule.went_offline(dev, now, 0.5)
        job = schedule.next(now)
        assert isinstance(job, Idle)
        pauses.append(job.until - now)
        assert isinstance(schedule.next(job.until - 1e-6), Idle)
        assert isinstance(schedule.next(job.until), Probe)
        now = job.until + 0.5
    for number, pause in enumerate(pauses):
        assert 0.9 <= pause / min(PAUSE_FIRST * 2**number, PROBE_PAUSE) <= 1.1
    assert len(set(pauses[8:])) == 4  # jitter
    dev.health.answered()
    schedule.came_online(dev, now)
    assert isinstance(schedule.next(now), PollEntry)


def test_all_offline_devices_together_get_a_twentieth_while_others_are_online() -> None:
    healthy = online(0, every=0.01)
    offline = [online(0, station=n) for n in range(2, 33)]
    schedule = Schedule([healthy, *offline], 0.0)
    for dev in offline:
        fail(dev)
        schedule.went_offline(dev, 0.0, 0.5)
    now, probing, probed = 10.0, 0.0, set()
    while now < 1000.0:
        match schedule.next(now):
            case Probe(found):
                now += 0.5
                probing += 0.5
                probed.add(found)
                schedule.went_offline(found, now, 0.5)
            case PollEntry() as poll:
                now += 0.02
                schedule.polled(poll, now)
    assert 0.8 * OFFLINE_SHARE <= probing / now <= OFFLINE_SHARE
    assert probed == set(offline)  # in turn


def test_a_long_probe_that_waits_for_its_share_holds_up_no_short_one_that_fits() -> None:
    healthy, patient, offline = online(0, every=0.3), weighing_machine(), online(0, station=3)
    schedule = Schedule([healthy, patient, offline], 0.0)
    for dev in (patient, offline):
        fail(dev)
        schedule.went_offline(dev, 0.0, 0.5)
    patient.health.probes.due = 0.0
    polled(schedule, 5.0)
    job = schedule.next(5.01)
    assert isinstance(job, Probe)
    assert (job.device, job.timeout) == (offline, UNKNOWN)


def test_a_station_that_replied_behind_a_short_probe_gets_a_patient_one_beside_due_polls() -> None:
    """Once: behind that one it is later than `reply_timeout`, and waits for its share."""
    healthy, back = online(0, every=0.1), online(0, station=2)
    schedule = Schedule([healthy, back], 0.0)
    fail(back)
    schedule.went_offline(back, 0.0, 5.0)
    back.health.probes.sent(short=True)
    for is_sent in (True, False):
        back.health.spoke(2.0, back.longest_reply)
        job = schedule.next(2.0)
        assert isinstance(job, Probe if is_sent else PollEntry)
        assert not isinstance(job, Probe) or (job.device, job.timeout) == (back, None)


def test_while_the_process_stood_still_no_probe_is_charged() -> None:
    """After four seconds none was sent for four minutes, after an hour for days."""
    healthy, lost = online(0), online(0, station=2)
    schedule = Schedule([healthy, lost], 0.0)
    fail(lost)
    schedule.went_offline(lost, 0.0, 3600.0)
    charged = probe_seconds(lost) + lost.longest_reply
    assert schedule.reachable(lost, charged / OFFLINE_SHARE + PROBE_PAUSE)


def test_one_offline_unit_of_a_network_gets_less_than_all_together() -> None:
    units = [
        made_device(f"d{n}", driver, WIRE, driver.timing, [make_tag("holding:0", driver)])
        for n in range(1, 6)
        for driver in [ModbusTcp(station=n)]
    ]
    schedule = Schedule(units, 0.0)
    units[0].health.answered()
    for silent, dev in enumerate(units[1:], 1):
        fail(dev)
        schedule.went_offline(dev, 0.0, 0.5)
        # Without idle time, a request is its next probe.
        free = 0.5 / min(OFFLINE_SHARE, silent * ONE_OFFLINE) - 0.5
        assert not schedule.reachable(dev, free - 0.1)
        assert schedule.reachable(dev, free + 0.1)


def test_offline_devices_get_all_the_time_while_none_is_online() -> None:
    offline = [online(0, station=n) for n in range(1, 4)]
    schedule = Schedule(offline, 0.0)
    for dev in offline:
        fail(dev)
    for dev in offline:
        schedule.went_offline(dev, 0.0, 0.5)
    assert isinstance(schedule.next(1.2), Probe)
    schedule.went_offline(offline[0], 1.7, 0.5)
    assert isinstance(schedule.next(1.7), Probe)


def test_an_offline_device_is_reachable_when_its_last_probe_is_a_second_old() -> None:
    healthy, offline = online(0), online(0, station=2)
    schedule = Schedule([healthy, offline], 0.0)
    fail(offline)
    schedule.went_offline(offline, 0.0, 0.5)
    assert schedule.reachable(healthy, 0.0)
    assert not schedule.reachable(offline, 0.9)
    assert schedule.reachable(offline, 1.0)


def test_while_polls_are_late_an_offline_device_is_reachable_only_in_its_share() -> None:
    healthy, offline = online(0, every=0.01), online(0, station=2)
    schedule = Schedule([healthy, offline], 0.0)
    fail(offline)
    schedule.went_offline(offline, 0.0, 0.5)
    polled(schedule, 5.0)
    assert not schedule.reachable(offline, 5.0)
    assert schedule.reachable(offline, 9.5)


def test_a_request_to_an_offline_device_has_it_probed_at_once_when_no_poll_is_due() -> None:
    healthy, offline = online(0), online(0, station=2)
    schedule = Schedule([healthy, offline], 0.0)
    fail(offline)
    for _ in range(3):
        schedule.went_offline(offline, 0.0, 0.5)
    schedule.requests.submit(write(offline))
    schedule.requests.submit(other := write(healthy))
    assert schedule.next(1.0) is other  # a poll is due
    assert polled(schedule, 1.0).device is healthy
    job = schedule.next(1.0)
    assert isinstance(job, Probe)
    assert job.device is offline
    assert job.timeout is not None


def test_starting_devices_get_one_short_probe_each_before_patient_ones() -> None:
    devices = [device([make_tag("D0")], station=n) for n in (1, 2, 3)]
    schedule = Schedule(devices, 0.0)
    jobs = list[tuple[Device, bool]]()
    for _ in range(6):
        job = schedule.next(0.0)
        assert isinstance(job, Probe)
        jobs.append((job.device, job.timeout is not None))
        fail(job.device)
        if job.timeout is None:
            schedule.went_offline(job.device, 0.0, 0.5)
    assert jobs == [(each, short) for short in (True, False) for each in devices]


def test_after_a_restart_the_devices_that_replied_last_time_go_first() -> None:
    silent, well = online(0), online(0, station=2)
    schedule = Schedule([silent, well], 0.0)
    fail(silent)
    schedule.went_offline(silent, 0.0, 0.5)
    for each in (silent, well):
        each.restart()
    schedule.opened(1.0)
    job = schedule.next(1.0)
    assert isinstance(job, Probe)
    assert job.device is well


def test_a_short_probe_waits_a_multiple_of_the_usual_turnaround_of_its_neighbours() -> None:
    healthy, offline = online(0), online(0, station=2)
    schedule = Schedule([healthy, offline], 0.0)
    fail(offline)

    def timeout(now: float) -> float | None:
        schedule.went_offline(offline, now, 0.5)
        while not isinstance(job := schedule.next(now + 10.0), Probe):
            assert isinstance(job, PollEntry)
            schedule.polled(job, now + 10.0)
        return job.timeout

    assert timeout(0.0) == UNKNOWN
    healthy.record.replies.turnaround = 0.03
    assert timeout(20.0) == USUAL * 0.03
    healthy.record.replies.turnaround = 0.001
    assert timeout(40.0) == SHORTEST
    offline.record.replies.turnaround = 0.06
    assert timeout(60.0) == USUAL * 0.06
    offline.record.replies.turnaround = 1.0
    assert timeout(80.0) == offline.timing.reply_timeout


def test_a_device_without_station_number_or_behind_a_network_gets_patient_probes_only() -> None:
    tcp = ModbusTcp(station=1)
    made = made_device("tcp", tcp, WIRE, tcp.timing, [make_tag("holding:1", tcp)])
    frames, other = weighing_machine(), online(0)
    for patient in (made, frames):
        assert short_timeout(patient, [patient, other]) is None
    assert short_timeout(other, [patient, other]) == UNKNOWN
    assert short_timeout(other, [other]) is None


def test_one_of_several_probes_of_an_offline_device_is_patient() -> None:
    offline = online(0)
    schedule = Schedule([offline, online(0, every=1000.0, station=2)], 0.0)
    polled(schedule, 0.0)
    fail(offline)
    now, patient = 0.0, []
    for _ in range(2 * PATIENT_AFTER + 2):
        schedule.went_offline(offline, now, 0.1)
        now += 10.0
        job = schedule.next(now)
        assert isinstance(job, Probe)
        patient.append(job.timeout is None)
    assert patient == 2 * [*[False] * PATIENT_AFTER, True]


def test_a_probe_uses_idle_time_if_it_ends_before_the_next_poll_is_due() -> None:
    healthy, offline = online(0), online(0, station=2)
    assert healthy.longest_poll < probe_seconds(offline, UNKNOWN)
    schedule = Schedule([healthy, offline], 0.0)
    fail(offline)
    schedule.went_offline(offline, 0.0, 0.5)  # beside idle time not before 9.5
    polled(schedule, 4.0)
    offline.health.probes.due = 0.0
    room = probe_seconds(offline, UNKNOWN)
    assert schedule.next(5.0 - 0.9 * room) == Idle(5.0)
    assert isinstance(schedule.next(5.0 - 1.1 * room), Probe)


def test_or_if_it_takes_no_longer_than_the_longest_poll() -> None:
    longer = device([make_tag(f"D{n}") for n in range(60)])
    longer.health.answered()
    offline = online(0, station=2)
    assert longer.longest_poll > probe_seconds(offline, UNKNOWN)
    schedule = Schedule([longer, offline], 0.0)
    fail(offline)
    schedule.went_offline(offline, 0.0, 0.5)
    polled(schedule, 4.0)
    offline.health.probes.due = 0.0
    assert isinstance(schedule.next(4.99), Probe)


def test_a_broadcast_device_is_never_probed() -> None:
    driver = ModbusRtu(station=0)
    tags = (make_tag("holding:1", driver),)
    dev = made_device("all", driver, WIRE, driver.timing, tags)
    assert dev.broadcast
    schedule = Schedule([dev], 0.0)
    assert schedule.next(0.0) == Idle(float("inf"))
    fail(dev)
    assert not dev.health.needs_resync


def test_a_poll_without_replies_is_sent_less_and_less() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    now, gaps = 0.0, []
    for _ in range(9):
        poll = schedule.next(now)
        assert isinstance(poll, PollEntry)
        schedule.polled(poll, now, answered=False)
        job = schedule.next(now)
        assert isinstance(job, Idle)
        gaps.append(job.until - now)
        now = job.until
    assert gaps == sorted(gaps)
    assert gaps[-1] == PAUSE_LONGEST
    polled(schedule, now)
    assert schedule.next(now) == Idle(now + 1.0)


def test_new_polls_are_due_at_once_and_the_replaced_one_is_sent_no_more() -> None:
    dev = online(0, 1)
    schedule = Schedule([dev], 0.0)
    whole = schedule.next(0.0)
    assert isinstance(whole, PollEntry)
    halves = dev.bad_addresses.refused(whole.block, 0, "28")
    schedule.replace(whole, halves, 0.0)
    assert {polled(schedule, 0.0).block.span for _ in halves} == {b.span for b in halves}
    assert schedule.next(0.0) == Idle(1.0)


def test_a_plan_keeps_the_age_and_due_time_of_a_block() -> None:
    dev = online(0, 1000)
    schedule = Schedule([dev], 0.0)
    polled(schedule, 0.0).reads.at = 0.25
    schedule.plan(dev, 0.5)
    first, second = schedule.polls(dev)
    assert first.reads.at == 0.25
    assert polled(schedule, 0.5) is second
    assert schedule.next(0.5) == Idle(1.0)


def test_requests_are_withdrawn_by_device_and_expire() -> None:
    one, two = online(0), online(0, station=2)
    schedule = Schedule([one, two], 0.0)
    writes = [write(one), write(two), write(one, submitted=1.0 - WRITE_EXPIRY), write(two)]
    for each in writes:
        assert schedule.requests.submit(each)
    assert schedule.requests.expired(0.9) == []
    assert schedule.requests.expired(1.0) == [writes[2]]
    assert schedule.requests.withdraw(two) == [writes[1], writes[3]]
    assert schedule.requests.withdraw() == [writes[0]]
    assert schedule.requests.withdraw() == []


def test_the_queue_takes_no_more_than_its_most_requests() -> None:
    dev = online(0)
    schedule = Schedule([dev], 0.0)
    assert all(schedule.requests.submit(write(dev)) for _ in range(MOST_WAITING))
    assert not schedule.requests.submit(write(dev))


def overloaded(*slow: int) -> Device:
    """Blocks that are asked for three times what the wire can carry, and blocks once an hour."""
    fast = [make_tag(f"D{1000 * n}", every=0.1) for n in range(6)]
    dev = device([*fast, *(make_tag(f"D{n}", every=3600.0) for n in slow)])
    dev.health.answered()
    return dev


def run_full(schedule: Schedule, begin: float, seconds: float) -> dict[str, list[float]]:
    """Polls all the time, 0.05 s each. Returns the times of the polls by the first tag."""
    now, found = begin, dict[str, list[float]]()
    while now < begin + seconds:
        job = schedule.next(now)
        assert isinstance(job, PollEntry)
        now += 0.05
        found.setdefault(job.block.tags[0].text, []).append(now)
        job.reads.at = now
        schedule.polled(job, now)
    return found


def test_on_an_overloaded_line_a_tag_of_once_an_hour_is_read_soon_after_start_and_return() -> None:
    dev = overloaded(8000)
    schedule = Schedule([dev, online(0, station=2)], 0.0)
    assert run_full(schedule, 0.0, 30.0)["D8000"][0] < 5.0
    schedule.came_online(dev, 100.0)
    assert run_full(schedule, 100.0, 30.0)["D8000"][0] < 105.0


def test_first_reads_of_many_blocks_leave_the_others_their_time() -> None:
    slow = range(6100, 8100, 70)
    dev = overloaded(*slow)
    found = run_full(Schedule([dev, online(0, station=2)], 0.0), 0.0, 120.0)
    assert all(f"D{n}" in found for n in slow)
    for n in range(6):
        gaps = [b - a for a, b in itertools.pairwise(found[f"D{1000 * n}"])]
        assert max(gaps) < 1.0
        assert len(gaps) > 0.85 * 120.0 / (7 * 0.05)


def test_a_block_that_turned_bad_on_an_overloaded_line_is_tried_again_soon() -> None:
    dev = overloaded(8000)
    schedule = Schedule([dev, online(0, station=2)], 0.0)
    run_full(schedule, 0.0, 30.0)
    poll = schedule.reader(dev, dev.tags[-1])
    assert poll is not None
    poll.forget(30.0)
    schedule.polled(poll, 30.0)  # it was refused, say
    assert poll.deadline < 30.0 + PAUSE_LONGEST + 5.0


class AnyOrder(RuleBasedStateMachine):
    """The calls of an engine to its schedule, in any order. The clock only goes on."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.devices = [
            device(
                [make_tag(f"D{n}", every=e) for n, e in ((0, 0.5), (1, 0.5), (900, 2.0))], station=s
            )
            for s in (1, 2, 3)
        ]
        self.schedule = Schedule(self.devices, self.now)
        self.running: PollEntry | None = None
        self.written = 0
        self.submitted = 0

    @rule(seconds=st.sampled_from([0.0, 0.01, 0.3, 1.0, 7.0, 100.0]))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds

    def _answered(self, found: Device) -> None:
        before = found.state
        found.health.answered()
        if before in (State.STARTING, State.OFFLINE):
            found.bad_addresses.abandon()
            self.schedule.came_online(found, self.now)

    def _unclear(self, found: Device) -> None:
        unknown = not found.health.online
        fail(found)
        self.schedule.failed(self.now, 1.0)
        if unknown or found.health.consecutive_failures > 2:
            self.schedule.went_offline(found, self.now, 1.0)

    @rule(answers=st.booleans(), refused=st.booleans(), expedited=st.booleans())
    def next_job(self, answers: bool, refused: bool, expedited: bool) -> None:
        match self.schedule.next(self.now):
            case Probe(found):
                (self._answered if answers else self._unclear)(found)
            case PollEntry() as poll:
                assert poll.live
                assert poll.device.health.online
                assert not poll.device.health.needs_resync
                assert poll.due <= self.now
                self.running = poll
                self.now += 0.05
                if expedited:
                    self.schedule.expedite(poll)
                self._end(poll, answers=answers, refused=refused)
                self.running = None
            case Write():
                self.written += 1
            case Idle(until):
                assert until > self.now
                assert not self._due()

    def _end(self, poll: PollEntry, *, answers: bool, refused: bool) -> None:
        found, schedule = poll.device, self.schedule
        if answers and not refused:
            self._answered(found)
            schedule.polled(poll, self.now)
        elif answers:
            self._answered(found)
            halves = found.bad_addresses.refused(poll.block, 0, "28")
            if halves:
                schedule.replace(poll, halves, self.now)
            else:
                schedule.polled(poll, self.now)
            if found.bad_addresses.settle(0.0):
                found.plan()
                schedule.plan(found, self.now)
        else:
            self._unclear(found)
            if found.state is State.OFFLINE:
                return
            if poll.tries < 2:
                schedule.again(poll)
            else:
                schedule.polled(poll, self.now, answered=False)

    @rule(which=st.integers(0, 2), number=st.integers(0, 9))
    def expedite(self, which: int, number: int) -> None:
        polls = self.schedule.polls(self.devices[which])
        self.schedule.expedite(polls[number % len(polls)])

    @rule(which=st.integers(0, 2))
    def submit(self, which: int) -> None:
        self.schedule.requests.submit(write(self.devices[which], submitted=self.now))
        self.submitted += 1

    @precondition(lambda self: self.submitted)
    @rule(which=st.integers(0, 2))
    def withdraw(self, which: int) -> None:
        self.submitted -= len(self.schedule.requests.withdraw(self.devices[which]))

    @rule(which=st.integers(0, 2))
    def plan(self, which: int) -> None:
        self.devices[which].plan()
        self.schedule.plan(self.devices[which], self.now)

    @rule()
    def open(self) -> None:
        for found in self.devices:
            found.restart()
        self.schedule.opened(self.now)

    def _queues(self, poll: PollEntry) -> int:
        queue = self.schedule._queue  # private: a lost poll shows only after its whole period
        entries = [*queue.waiting, *(e for own in queue.by_device.values() for e in own.heap)]
        valid = [one for _, ticket, one in entries if one is poll and ticket == poll.ticket]
        return len(valid) + sum(one is poll for one in queue.expedited)

    def _due(self) -> list[PollEntry]:
        return [
            poll
            for found in self.devices
            if found.health.online
            for poll in self.schedule.polls(found)
            if poll.due <= self.now
        ]

    @invariant()
    def every_poll_of_an_online_device_is_in_exactly_one_queue(self) -> None:
        for found in self.devices:
            covered = {tag for poll in self.schedule.polls(found) for tag in poll.block.tags}
            assert covered == set(found.tags)
            for poll in self.schedule.polls(found):
                assert poll.live
                if found.health.online and poll is not self.running:
                    assert self._queues(poll) == 1, poll

    @invariant()
    def no_request_is_lost(self) -> None:
        assert len(self.schedule.requests.waiting) == self.submitted - self.written


AnyOrder.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAnyOrder = AnyOrder.TestCase
