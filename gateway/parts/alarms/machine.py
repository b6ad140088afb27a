"""One alarm: a state machine after ISA-18.2. It does no I/O and has no clock.

A bad value holds everything: an alarm neither comes nor goes by it, and the time of a delay stands
still. An uncertain value can raise an alarm, because the plant may be beyond what the sensor can
measure. It ends none, because the sensor may be broken.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from gateway.errors import NothingToAcknowledge
from gateway.tags import Quality
from gateway.tags.alarm import BELOW, AlarmRule, Level
from gateway.values import Value
from gateway.values.numerals import are_apart


class State(StrEnum):
    """States of an alarm. The names of ISA-18.2 are in docs/alarms.md."""

    NORMAL = "normal"
    ACTIVE = "active"  # a limit is reached; not acknowledged
    ACKNOWLEDGED = "acknowledged"  # a limit is still reached
    RETURNED = "returned"  # no limit is reached any more; not acknowledged


class Event(StrEnum):
    """Events that change an alarm."""

    RAISED = "raised"  # a limit is reached, or a worse one
    EASED = "eased"  # only a less severe limit is still reached
    ENDED = "ended"  # no limit is reached any more
    ACKNOWLEDGED = "acknowledged"
    FOLDED = "folded"  # it is part of another alarm now
    UNFOLDED = "unfolded"  # it is one of its own again, and was acknowledged before
    SHELVED = "shelved"
    UNSHELVED = "unshelved"
    REMOVED = "out of service"
    PUT_BACK = "in service"


_S, _E = State, Event
TRANSITIONS: Mapping[tuple[State, Event], State] = {
    (_S.NORMAL, _E.RAISED): _S.ACTIVE,
    (_S.ACTIVE, _E.RAISED): _S.ACTIVE,
    (_S.ACKNOWLEDGED, _E.RAISED): _S.ACTIVE,
    (_S.RETURNED, _E.RAISED): _S.ACTIVE,
    (_S.ACTIVE, _E.EASED): _S.ACTIVE,
    (_S.ACKNOWLEDGED, _E.EASED): _S.ACKNOWLEDGED,
    (_S.ACTIVE, _E.ENDED): _S.RETURNED,
    (_S.ACKNOWLEDGED, _E.ENDED): _S.NORMAL,
    (_S.ACTIVE, _E.ACKNOWLEDGED): _S.ACKNOWLEDGED,
    (_S.RETURNED, _E.ACKNOWLEDGED): _S.NORMAL,
    (_S.ACTIVE, _E.FOLDED): _S.NORMAL,
    (_S.ACKNOWLEDGED, _E.FOLDED): _S.NORMAL,
    (_S.NORMAL, _E.UNFOLDED): _S.ACKNOWLEDGED,
    **{(state, event): _S.NORMAL for state in State for event in (_E.SHELVED, _E.REMOVED)},
}
IN_ALARM = (State.ACTIVE, State.ACKNOWLEDGED)  # a limit is reached
UNACKNOWLEDGED = (State.ACTIVE, State.RETURNED)


class Acknowledgement(NamedTuple):
    """The operator that acknowledged. `via`: the client that sent it, if it is known."""

    by: str
    time: int  # ns since 1970
    via: str | None = None


class Suppression(NamedTuple):
    """An alarm that an operator has shelved, or taken out of service: it is judged, and raises
    nothing. `until`: ns since 1970; None: until it is put back, out of service."""

    by: str
    time: int  # ns since 1970
    reason: str
    until: int | None = None
    via: str | None = None


class Status(NamedTuple):
    """An alarm at one moment. Replaced as a whole: any thread may read it.

    `level` is the worst limit that is reached; in state `returned`, or folded, the last one. Times
    in ns since 1970; 0: never.
    """

    state: State = State.NORMAL
    level: Level | None = None
    since: int = 0  # the state or the level began
    raised: int = 0  # of the last event `raised`: an acknowledgement is for this one
    value: Value | None = None  # at the last event
    acknowledged: Acknowledgement | None = None  # of the last event `raised`
    folded: bool = False  # it would be active or acknowledged, if it was no part of another alarm
    suppressed: Suppression | None = None


class _Condition:
    """One limit with hysteresis. It counts when it was reached for the delay, until it was left for
    the off-delay."""

    __slots__ = ("_limit", "_reached", "_rule", "_sign", "_since", "_waited", "active", "level")

    def __init__(self, rule: AlarmRule, level: Level, limit: float) -> None:
        self.level = level
        self.active = False  # it counts
        self._rule = rule
        self._sign = -1 if level in BELOW else 1
        self._limit = self._sign * limit
        self._reached = False
        self._waited = 0.0  # good time since it is reached, or left
        self._since: float | None = None  # that time runs since then

    @property
    def due(self) -> float | None:
        """When the delay ends; None while it does not run."""
        if self._since is None:
            return None
        delay = self._rule.delay if self._reached else self._rule.off_delay
        return self._since + delay - self._waited

    def judge(self, value: float, now: float, *, certain: bool) -> None:
        value *= self._sign
        is_below = value < self._limit
        if is_below and not certain:
            self.suspend(now)
            return
        holds = self._reached and not are_apart(self._limit, value, self._rule.hysteresis)
        reached = holds or not is_below
        if reached is not self._reached:
            self._reached, self._waited, self._since = reached, 0.0, None
        if reached is not self.active and self._since is None:
            self._since = now

    def elapse(self, now: float) -> bool:
        """Ends the delay. True if the limit counts from now on."""
        if self.due is None or now < self.due:
            return False
        self.active, self._since = self._reached, None
        return self.active

    def suspend(self, now: float) -> None:
        """Holds the time of the delay."""
        if self._since is not None:
            self._waited += max(0.0, now - self._since)
            self._since = None

    def restore(self) -> None:
        self.active = self._reached = True


class Alarm:
    """The alarm of one value. `now`: seconds of a steady clock; `time`: ns since 1970."""

    __slots__ = ("_conditions", "is_part", "quality", "rule", "status", "value")

    def __init__(self, rule: AlarmRule) -> None:
        self.rule = rule
        self.status = Status()
        self.quality = Quality.BAD  # of the value
        self.is_part = False  # of another alarm: it is judged, and raises nothing
        self.value: Value | None = None  # the last one that was not bad
        worst_first = [level for level in Level if level in rule.limits]
        self._conditions = [_Condition(rule, level, rule.limits[level]) for level in worst_first]

    @property
    def due(self) -> float | None:
        """When `elapse` is to be called; None: not needed."""
        return min((one.due for one in self._conditions if one.due is not None), default=None)

    @property
    def reached(self) -> Level | None:
        """The worst limit that counts now."""
        return next((one.level for one in self._conditions if one.active), None)

    def judge(
        self, value: Value, now: float, time: int, quality: Quality = Quality.GOOD
    ) -> Event | None:
        """Applies a good or uncertain value. Call `elapse` with the same time before it."""
        self.quality, self.value = quality, value
        if isinstance(value, (str, tuple)):
            return None
        for condition in self._conditions:
            condition.judge(value, now, certain=quality is Quality.GOOD)
        return self.elapse(now, time)

    def suspend(self, now: float) -> None:
        """Applies a bad value: the alarm stays as it is."""
        self.quality = Quality.BAD
        for condition in self._conditions:
            condition.suspend(now)

    def elapse(self, now: float, time: int) -> Event | None:
        """Applies the delays that have ended."""
        new = [one.level for one in self._conditions if one.elapse(now)]
        level, before = self.reached, self.status
        was_in_alarm = before.state in IN_ALARM
        if before.folded and level is None:
            self.status = before = before._replace(folded=False, level=None)
        if self.is_suppressed or level is (before.level if was_in_alarm else None):
            return None
        event = Event.ENDED
        if level is not None and before.folded and before.acknowledged is not None:
            event = Event.UNFOLDED
        elif level is not None:
            event = Event.RAISED if level in new or not was_in_alarm else Event.EASED
        state = TRANSITIONS[before.state, event]
        changed = before._replace(state=state, since=time, value=self.value, folded=False)
        if event is Event.RAISED:
            changed = changed._replace(level=level, raised=time, acknowledged=None)
        elif event in (Event.EASED, Event.UNFOLDED) or state is State.NORMAL:
            changed = changed._replace(level=level)
        self.status = changed
        return event

    @property
    def is_kept(self) -> bool:
        """True if a normal alarm has more than its state."""
        return self.status.folded or self.status.suppressed is not None

    @property
    def is_suppressed(self) -> bool:
        return self.is_part or self.status.suppressed is not None

    def suppress(self, what: Suppression) -> Event:
        """Shelves it, or takes it out of service."""
        event = Event.REMOVED if what.until is None else Event.SHELVED
        state = TRANSITIONS[self.status.state, event]
        known = self.status._replace(state=state, level=None, folded=False)
        self.status = known._replace(since=what.time, value=self.value, suppressed=what)
        return event

    def release(self, time: int) -> Event | None:
        """Puts it back. Call `elapse` after it: a limit that is reached raises it again."""
        was = self.status.suppressed
        if was is None:
            return None
        self.status = self.status._replace(suppressed=None, since=time)
        return Event.PUT_BACK if was.until is None else Event.UNSHELVED

    def fold(self, time: int) -> Event | None:
        """Makes it part of another alarm, until `unfold`. Its acknowledgement is kept."""
        self.is_part = True
        if self.status.state not in IN_ALARM:
            return None
        state = TRANSITIONS[self.status.state, Event.FOLDED]
        self.status = self.status._replace(state=state, since=time, folded=True)
        return Event.FOLDED

    def unfold(self, now: float, time: int) -> Event | None:
        """Makes it an alarm of its own again: raised, if a limit is still reached."""
        if not self.is_part:
            return None
        self.is_part = False
        return self.elapse(now, time)

    def acknowledge(
        self, by: str, time: int, via: str | None = None, raised: int | None = None
    ) -> Event | None:
        """Acknowledges for an operator. `raised`: the event that the operator saw.

        Returns None for a repeat, which changes nothing. Raises `NothingToAcknowledge`.
        """
        status = self.status
        if raised is not None and raised != status.raised:
            raise NothingToAcknowledge("it was raised again meanwhile: look at it first")
        if status.state in UNACKNOWLEDGED:
            state = TRANSITIONS[status.state, Event.ACKNOWLEDGED]
            self.status = status._replace(
                state=state,
                since=time,
                level=status.level if state in IN_ALARM else None,
                acknowledged=Acknowledgement(by, time, via),
            )
            return Event.ACKNOWLEDGED
        known = status.acknowledged
        if known is None or (status.state is State.NORMAL and raised is None and known.by != by):
            raise NothingToAcknowledge("it is normal: there is nothing to acknowledge")
        return None

    def restore(self, status: Status) -> None:
        """Takes over the status before a restart. A limit that the file no longer has is left."""
        levels = [one.level for one in self._conditions]
        if status.folded and status.level not in levels:
            status = status._replace(folded=False, level=None)
        if status.state in IN_ALARM and status.level not in levels:
            state = TRANSITIONS[status.state, Event.ENDED]
            level = status.level if state is State.RETURNED else None
            status = status._replace(state=state, level=level)
        self.status, self.is_part = status, status.folded
        if not (status.folded or status.state in IN_ALARM) or status.level is None:
            return
        is_below = status.level in BELOW
        for condition in self._conditions[levels.index(status.level) :]:
            if (condition.level in BELOW) is is_below:  # with a limit its less severe one
                condition.restore()
