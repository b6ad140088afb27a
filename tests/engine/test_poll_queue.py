"""The queue of polls: by due time, then by deadline, and expedited ones first."""

import random

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from gateway.engine.device.device import Device
from gateway.engine.jobs.poll_entry import EXPEDITED, NOT_QUEUED, PollEntry
from gateway.engine.schedule.poll_queue import ROOM, PollQueue
from tests.sim.plant import device, make_tag


def online(station: int = 1) -> Device:
    tags = [make_tag("D0", every=1.0), make_tag("D900", every=5.0)]
    found = device(tags, station=station)
    found.health.answered()
    return found


def polls(of: Device, *dues: float, block: int = 0) -> list[PollEntry]:
    return [PollEntry(of, of.blocks[block], due) for due in dues]


def queue(*pushed: PollEntry) -> PollQueue:
    made = PollQueue()
    made.push_all(pushed)
    return made


def first(made: PollQueue, now: float) -> PollEntry | None:
    return made.due if made.ripen(now) else None


def test_a_poll_is_due_from_its_due_time_on() -> None:
    [poll] = polls(online(), 2.0)
    made = queue(poll)
    assert not made.ripen(1.9)
    assert made.ripen(2.0)
    assert first(made, 2.0) is poll


def test_due_polls_go_by_deadline() -> None:
    of = online()
    [slow], [fast] = polls(of, 0.0, block=1), polls(of, 3.0)
    made = queue(slow, fast)
    assert first(made, 2.0) is slow
    assert first(made, 3.0) is fast  # until 4.0, the slow one until 5.0


def test_of_equal_polls_the_one_pushed_first_goes_first() -> None:
    same = polls(online(), 0.0, 0.0, 0.0)
    assert first(queue(*same), 0.0) is same[0]


def test_a_pushed_poll_leaves_a_stale_entry_behind() -> None:
    [poll] = polls(online(), 0.0)
    made = queue(poll)
    poll.due = 5.0
    made.push(poll)
    assert not made.ripen(4.9)
    assert first(made, 5.0) is poll
    assert list(made.valid()) == [poll]


def test_an_expedited_poll_goes_first_once_and_is_not_pushed_until_taken() -> None:
    ready, late = polls(online(), 0.0, 9.0)
    made = queue(ready, late)
    made.expedite(late)
    made.expedite(late)
    made.push(late)
    assert made.ripen(0.0)
    assert list(made.expedited) == [late]
    assert late.ticket == EXPEDITED
    made.expedited.remove(late)
    late.ticket = NOT_QUEUED
    made.push(late)
    assert first(made, 9.0) is ready


def test_polls_of_a_device_that_is_not_online_are_left_out() -> None:
    of = online()
    poll, other = polls(of, 0.0, 0.0)
    made = queue(poll)
    made.expedite(other)
    of.health.gave_up(0.0, 1.0)
    made.push(poll)
    assert not made.ripen(0.0)
    assert list(made.valid()) == []


def test_replaced_polls_are_left_out() -> None:
    poll, kept = polls(online(), 0.0, 0.0)
    made = queue(poll, kept)
    poll.live = False
    assert first(made, 0.0) is kept
    made.push(poll)
    assert list(made.valid()) == [kept]


def test_stale_entries_are_dropped_when_there_are_many() -> None:
    many = polls(online(), *[0.0] * 10)
    made, chance = PollQueue(), random.Random(1)
    for n in range(2000):
        poll = chance.choice(many)
        poll.due = float(n) + chance.random()
        made.push(poll)
        made.ripen(n / 2)
        assert len(made.waiting) <= 2 * len(many) + ROOM + 1
        assert made.entries <= 2 * (2 * len(many) + ROOM + 1)
    assert first(made, 1e9) is min(made.valid(), key=lambda poll: (poll.deadline, poll.ticket))


@pytest.mark.parametrize("seed", range(8))
def test_late_polls_go_by_use_of_the_wire_and_others_by_deadline(seed: int) -> None:
    """The queue compares few polls; this test compares all."""
    chance = random.Random(seed)
    devices = [online(station) for station in range(1, 9)]
    made, now = PollQueue(), 0.0
    made.push_all(poll for of in devices for poll in polls(of, *range(6)))
    for _ in range(600):
        now += chance.choice((0.0, 0.01, 0.3, 1.5))
        if not made.ripen(now):
            continue
        due = list(made.valid())
        late = [poll for poll in due if poll.deadline < now]
        by_use = min((poll.device.use, poll.deadline) for poll in late) if late else None
        poll = made.due
        assert poll is not None
        if by_use is None:
            assert poll.deadline == min(other.deadline for other in due)
        else:
            assert (poll.device.use, poll.deadline) == by_use
        taken = [poll]
        poll.ticket = NOT_QUEUED
        if chance.random() < 0.3:
            own = sorted(p.deadline for p in due if p.device is poll.device and p is not poll)
            more = made.more(poll.device, 2)
            assert [other.deadline for other in more] == own[:2]
            taken += more
        if chance.random() < 0.1:
            made.expedite(other := chance.choice(due))
            assert made.ripen(now)
            made.expedited.clear()
            taken.append(other)
        took = chance.choice((0.02, 0.2, 0.6))
        poll.device.used(now + took, now)
        now += took
        for each in dict.fromkeys(taken):
            each.ticket = NOT_QUEUED
            each.due = now + chance.choice((0.0, 0.5, 4.0))
            made.push(each)


class AnyOrder(RuleBasedStateMachine):
    """The calls of a schedule to its queue, in any order, and what must be due after each."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.devices = [online(1), online(2)]
        self.polls = [poll for of in self.devices for poll in polls(of, *[0.0] * (ROOM + 4))]
        self.taken: list[PollEntry] = []
        self.queue = queue(*self.polls)

    @rule(which=st.integers(0, 99), pause=st.sampled_from([0.0, 0.5, 4.0]), times=st.integers(1, 9))
    def add(self, which: int, pause: float, times: int) -> None:
        poll = self.polls[which % len(self.polls)]
        for _ in range(times):
            poll.due = self.now + pause
            self.queue.push(poll)

    @rule(pause=st.sampled_from([0.0, 0.3, 1.5, 9.0]))
    def ripen(self, pause: float) -> None:
        self.now += pause
        assert self.queue.ripen(self.now) is bool(self.due() or self.queue.expedited)
        due, late = self.due(), [poll for poll in self.due() if poll.deadline < self.now]
        found = self.queue.due
        assert (found is not None) is bool(due)
        if found is not None and late:
            assert found.deadline == min(p.deadline for p in late if p.device is found.device)
            assert found.device.use == min(poll.device.use for poll in late)
        elif found is not None:
            assert found.deadline == min(poll.deadline for poll in due)

    @rule(took=st.sampled_from([0.02, 0.6]), together=st.integers(0, 3))
    def take(self, took: float, together: int) -> None:
        self.ripen(0.0)
        poll = self.queue.due
        if poll is None:
            return
        poll.ticket = NOT_QUEUED
        for each in (poll, *self.queue.more(poll.device, together)):
            each.ticket = NOT_QUEUED
            self.taken.append(each)
        poll.device.used(self.now + took, self.now)
        self.now += took

    @rule(which=st.integers(0, 99), on_demand=st.booleans())
    def expedite(self, which: int, *, on_demand: bool) -> None:
        poll = self.polls[which % len(self.polls)]
        if poll not in self.taken and poll.device.health.online:
            self.queue.expedite(poll, on_demand=on_demand)
            tickets = [one.ticket for one in self.queue.expedited]
            assert poll.ticket in tickets
            assert tickets == sorted(tickets, reverse=True)  # on demand behind the others

    @rule()
    def take_expedited(self) -> None:
        self.ripen(0.0)
        if self.queue.expedited:
            poll = self.queue.expedited.popleft()
            assert poll.live
            assert poll.device.health.online
            poll.ticket = NOT_QUEUED
            self.taken.append(poll)

    @rule(pause=st.sampled_from([0.0, 1.0]))
    def put_back(self, pause: float) -> None:
        for poll in self.taken:
            poll.due = self.now + pause
            self.queue.push(poll)
        self.taken.clear()

    @rule(which=st.integers(0, 1))
    def goes_offline(self, which: int) -> None:
        if self.devices[which].health.online:
            self.devices[which].health.gave_up(self.now, 1.0)

    @rule(which=st.integers(0, 1))
    def comes_online(self, which: int) -> None:
        of = self.devices[which]
        if of.health.answered():
            self.replace(of, polls(of, *[self.now] * (ROOM + 4)))

    @rule(which=st.integers(0, 1), count=st.integers(1, 3))
    def planned(self, which: int, count: int) -> None:
        self.replace(self.devices[which], polls(self.devices[which], *[self.now] * count))

    @rule()
    def changed(self) -> None:
        expedited = list(self.queue.expedited)
        self.queue = queue(*self.polls)
        self.queue.expedited.extend(expedited)

    def replace(self, of: Device, new: list[PollEntry]) -> None:
        for poll in self.polls:
            poll.live = poll.live and poll.device is not of
        self.polls = [poll for poll in self.polls if poll.live] + new
        self.taken = [poll for poll in self.taken if poll.live]
        self.queue.push_all(new)

    def due(self) -> list[PollEntry]:
        ready = (poll for poll in self.polls if poll.device.health.online)
        return [p for p in ready if p.due <= self.now and p.ticket > NOT_QUEUED]


AnyOrder.TestCase.settings = settings(max_examples=80, stateful_step_count=30, deadline=None)
TestAnyOrder = AnyOrder.TestCase
