"""One alarm: limits, hysteresis, delay, acknowledgement, and no effect of bad values."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import NothingToAcknowledge
from gateway.parts.alarms.machine import IN_ALARM, TRANSITIONS, Alarm, Event, State, Status
from gateway.tags import AlarmRule, Level, Quality

HIGH, LOW, HYSTERESIS = 80.0, 10.0, 5.0
ON_HIGH = AlarmRule({Level.HIGH: HIGH})
FOUR = AlarmRule(
    {Level.HIGH_HIGH: 95.0, Level.HIGH: HIGH, Level.LOW_LOW: 5.0, Level.LOW: LOW}, HYSTERESIS
)


class Driven:
    """An alarm with a clock, driven as the gateway does it: `elapse` at each `due`."""

    def __init__(self, rule: AlarmRule) -> None:
        self.alarm = Alarm(rule)
        self.now = 0.0
        self.events: list[Event] = []

    def state(self) -> State:
        return self.alarm.status.state

    def level(self) -> Level | None:
        return self.alarm.status.level

    @property
    def time(self) -> int:
        return int(self.now * 1e9) + 1

    def wait(self, seconds: float) -> None:
        until = self.now + seconds
        while (due := self.alarm.due) is not None and due <= until:
            self.now = due
            self._note(self.alarm.elapse(due, self.time))
        self.now = until

    def good(self, value: float | bool, after: float = 1.0) -> State:
        self.wait(after)
        self._note(self.alarm.judge(value, self.now, self.time))
        return self.state()

    def uncertain(self, value: float, after: float = 1.0) -> State:
        self.wait(after)
        self._note(self.alarm.judge(value, self.now, self.time, Quality.UNCERTAIN))
        return self.state()

    def bad(self, after: float = 1.0) -> State:
        self.wait(after)
        self.alarm.suspend(self.now)
        return self.state()

    def acknowledge(self, by: str = "Ana", raised: int | None = None) -> State:
        self._note(self.alarm.acknowledge(by, self.time, raised=raised))
        return self.state()

    def _note(self, event: Event | None) -> None:
        if event is not None:
            self.events.append(event)


def test_the_four_states() -> None:
    alarm = Driven(ON_HIGH)
    assert alarm.good(79.9) is State.NORMAL
    assert alarm.good(80) is State.ACTIVE
    assert alarm.acknowledge() is State.ACKNOWLEDGED
    assert alarm.good(79) is State.NORMAL
    assert alarm.good(81) is State.ACTIVE
    assert alarm.good(79) is State.RETURNED
    assert alarm.acknowledge() is State.NORMAL
    assert alarm.alarm.status.level is None


def test_an_alarm_that_returned_is_active_again() -> None:
    alarm = Driven(ON_HIGH)
    alarm.good(81)
    assert alarm.good(79) is State.RETURNED
    assert alarm.good(81) is State.ACTIVE


def test_a_worse_level_must_be_acknowledged_again_and_a_better_one_not() -> None:
    alarm = Driven(FOUR)
    alarm.good(85)
    alarm.acknowledge()
    assert (alarm.good(96), alarm.level()) == (State.ACTIVE, Level.HIGH_HIGH)
    alarm.acknowledge()
    assert (alarm.good(89), alarm.level()) == (State.ACKNOWLEDGED, Level.HIGH)
    assert (alarm.good(4), alarm.level()) == (State.ACTIVE, Level.LOW_LOW)
    assert alarm.alarm.status.acknowledged is None


@pytest.mark.parametrize(
    ("rule", "reached", "held", "left"),
    [
        (FOUR, 80, 75.1, 75),
        (FOUR, 10, 14.9, 15),
        (ON_HIGH, 80, 80, 79.99),
        (AlarmRule({Level.HIGH: 0.3}, hysteresis=0.1), 0.3, 0.21, 0.2),
        (AlarmRule({Level.LOW: 0.7}, hysteresis=0.1), 0.7, 0.79, 0.8),
        (AlarmRule({Level.LOW: -0.3}, hysteresis=0.1), -0.3, -0.21, -0.2),
        (AlarmRule({Level.ON: 1.0}), True, True, False),
        (AlarmRule({Level.OFF: 0.0}), False, False, True),
    ],
)
def test_a_limit_is_left_only_beyond_the_hysteresis(
    rule: AlarmRule, reached: float, held: float, left: float
) -> None:
    alarm = Driven(rule)
    assert alarm.good(reached) is State.ACTIVE
    assert alarm.good(held) is State.ACTIVE
    assert alarm.good(left) is State.RETURNED


def test_a_delay_ends_without_a_new_sample() -> None:
    alarm = Driven(AlarmRule({Level.HIGH: HIGH}, delay=5.0))
    assert alarm.good(85) is State.NORMAL
    alarm.wait(4.9)
    assert alarm.state() is State.NORMAL
    alarm.wait(0.1)
    assert alarm.state() is State.ACTIVE


def test_a_value_that_is_back_before_the_delay_ends_is_no_alarm() -> None:
    alarm = Driven(AlarmRule({Level.HIGH: HIGH}, delay=5.0))
    alarm.good(85)
    alarm.good(70, after=4.0)
    alarm.good(85, after=1.0)
    alarm.wait(4.9)
    assert alarm.events == []


@pytest.mark.parametrize(
    ("steps", "events"),
    [
        ([85, 70, 70, 85, 70], "raised"),  # it chatters: one alarm
        ([85, 70, 4.9], "raised"),
        ([85, 70, 5.0], "raised ended"),
        ([85, 70, None, 100.0, 70, 3.9], "raised"),  # bad time does not count
        ([85, 70, None, 100.0, 70, 4.0], "raised ended"),
    ],
)
def test_an_alarm_ends_when_its_limit_was_left_for_the_off_delay(
    steps: list[float | None], events: str
) -> None:
    """Integers are values, one second after the other; floats are seconds; None is bad."""
    alarm = Driven(AlarmRule({Level.HIGH: HIGH}, off_delay=5.0))
    for step in steps:
        if step is None:
            alarm.bad()
        elif isinstance(step, int):
            alarm.good(step)
        else:
            alarm.wait(step)
    assert " ".join(alarm.events) == events


def test_the_delay_of_a_worse_level_counts_from_that_level() -> None:
    alarm = Driven(AlarmRule({Level.HIGH_HIGH: 95, Level.HIGH: HIGH}, delay=5.0))
    alarm.good(85)
    alarm.good(96, after=4.0)
    alarm.wait(1.0)
    assert alarm.level() is Level.HIGH
    alarm.wait(4.0)
    assert alarm.level() is Level.HIGH_HIGH


def test_bad_time_does_not_count_for_the_delay_and_does_not_end_it() -> None:
    alarm = Driven(AlarmRule({Level.HIGH: HIGH}, delay=5.0))
    alarm.good(85)
    alarm.bad(after=3.0)
    alarm.wait(100.0)
    assert alarm.state() is State.NORMAL
    alarm.good(85)
    alarm.wait(1.9)
    assert alarm.state() is State.NORMAL
    alarm.wait(0.1)
    assert alarm.state() is State.ACTIVE


def test_a_bad_value_clears_no_alarm() -> None:
    alarm = Driven(FOUR)
    alarm.good(85)
    assert alarm.bad() is State.ACTIVE
    alarm.acknowledge()
    assert alarm.bad(after=1000.0) is State.ACKNOWLEDGED
    assert alarm.alarm.quality is Quality.BAD


def test_an_uncertain_value_raises_an_alarm_and_ends_none() -> None:
    alarm = Driven(AlarmRule({Level.HIGH: HIGH, Level.LOW: LOW}))
    assert alarm.good(50) is State.NORMAL
    assert alarm.uncertain(103) is State.ACTIVE  # beyond what the sensor measures
    assert alarm.level() is Level.HIGH
    assert alarm.uncertain(50) is State.ACTIVE
    assert alarm.good(50) is State.RETURNED
    assert alarm.uncertain(-25) is State.ACTIVE  # a broken wire
    assert alarm.level() is Level.LOW


def test_the_delay_of_an_alarm_stands_still_while_an_uncertain_value_is_below() -> None:
    alarm = Driven(AlarmRule({Level.HIGH: HIGH}, delay=5.0))
    alarm.good(85)
    alarm.uncertain(-25, after=3.0)
    alarm.wait(100.0)
    assert alarm.state() is State.NORMAL
    alarm.uncertain(103)
    alarm.wait(1.9)
    assert alarm.state() is State.NORMAL
    alarm.wait(0.1)
    assert alarm.state() is State.ACTIVE


def test_nothing_to_acknowledge_is_said() -> None:
    alarm = Driven(ON_HIGH)
    with pytest.raises(NothingToAcknowledge, match="it is normal"):
        alarm.acknowledge()


def test_a_repeated_acknowledgement_changes_nothing() -> None:
    alarm = Driven(ON_HIGH)
    alarm.good(85)
    alarm.acknowledge("Ana")
    first = alarm.alarm.status
    alarm.now += 1
    alarm.acknowledge("Bo")
    assert alarm.alarm.status == first
    alarm.good(70)
    after = alarm.alarm.status
    alarm.acknowledge("Ana")
    alarm.acknowledge("Bo", raised=first.raised)
    assert alarm.alarm.status == after
    with pytest.raises(NothingToAcknowledge):
        alarm.acknowledge("Bo")


def test_an_acknowledgement_of_an_earlier_alarm_is_refused() -> None:
    alarm = Driven(ON_HIGH)
    alarm.good(85)
    seen = alarm.alarm.status.raised
    alarm.good(70)
    alarm.good(85)
    with pytest.raises(NothingToAcknowledge, match="raised again"):
        alarm.acknowledge(raised=seen)
    assert alarm.state() is State.ACTIVE


def test_a_restored_alarm_goes_on() -> None:
    before = Driven(FOUR)
    before.good(96)
    before.acknowledge()
    after = Driven(FOUR)
    after.alarm.restore(before.alarm.status)
    assert after.bad() is State.ACKNOWLEDGED
    assert (after.good(85), after.alarm.status.level) == (State.ACKNOWLEDGED, Level.HIGH)
    assert after.good(74) is State.NORMAL


@pytest.mark.parametrize(
    ("state", "then"),
    [(State.ACTIVE, State.RETURNED), (State.ACKNOWLEDGED, State.NORMAL)],
)
def test_a_limit_that_the_file_no_longer_has_is_left(state: State, then: State) -> None:
    alarm = Driven(ON_HIGH)
    alarm.alarm.restore(Status(state, Level.LOW, since=1, raised=1))
    assert alarm.state() is then


_STEPS = st.lists(
    st.tuples(
        st.sampled_from([0.0, 0.5, 1.0, 2.5, 5.0, 7.0]),
        st.one_of(
            st.sampled_from([0.0, 4.0, 5.0, 10.0, 14.0, 15.0, 50.0, 75.0, 76.0, 80.0, 91.0, 95.0]),
            st.sampled_from(["bad", "acknowledge"]),
        ),
    ),
    max_size=40,
)


class _Latch:
    """The reference for one limit, in steps of half a second."""

    def __init__(self, sign: int, limit: float, delay: float, off_delay: float) -> None:
        self.sign, self.limit, self.delays = sign, sign * limit, (off_delay, delay)
        self.reached = self.active = False
        self.held = 0.0  # seconds of good values since it is reached, or left

    def good(self, value: float) -> None:
        value *= self.sign
        if self.reached and value <= self.limit - HYSTERESIS:
            self.reached, self.held = False, 0.0
        elif not self.reached and value >= self.limit:
            self.reached, self.held = True, 0.0
        self.wait(0.0)

    def wait(self, seconds: float) -> None:
        self.held += seconds
        if self.held >= self.delays[self.reached]:
            self.active = self.reached


@settings(max_examples=150)
@given(_STEPS, st.sampled_from([0.0, 2.5]), st.sampled_from([0.0, 5.0]))
def test_any_course_of_values(
    steps: list[tuple[float, float | str]], delay: float, off_delay: float
) -> None:
    """Bad values hold everything, each change is a transition of the table, limits have their
    hysteresis and their delay."""
    alarm = Driven(AlarmRule({Level.HIGH: HIGH, Level.LOW: LOW}, HYSTERESIS, delay, off_delay))
    latches = [_Latch(1, HIGH, delay, off_delay), _Latch(-1, LOW, delay, off_delay)]
    was_good = False
    for seconds, step in steps:
        before, seen = alarm.state(), len(alarm.events)
        alarm.wait(seconds)
        if was_good:
            for latch in latches:
                latch.wait(seconds)
        if not was_good:
            assert alarm.events[seen:] == []
        if step == "bad":
            held = alarm.state()
            assert alarm.bad(after=0.0) is held
            was_good = False
        elif step == "acknowledge":
            if alarm.state() in (State.ACTIVE, State.RETURNED):
                alarm.acknowledge()
        else:
            alarm.good(float(step), after=0.0)
            was_good = True
            for latch in latches:
                latch.good(float(step))
        state = before
        for event in alarm.events[seen:]:
            state = TRANSITIONS[state, event]
        assert state is alarm.state()
        assert (alarm.state() in IN_ALARM) is any(latch.active for latch in latches)
