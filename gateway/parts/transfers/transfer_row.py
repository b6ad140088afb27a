"""One transfer: which write is due, what it carries, and its state. No I/O, no clock.

A row carries only a good value whose last read is younger than `stale`; none that is uncertain. It
carries each value once: a write that may have been done is not repeated. At most one write is under
way. A write lets the block of its target be read at once, which may hold the source: so the next
change waits for the interval of the source.
"""

import math
from collections import Counter
from enum import StrEnum
from typing import NamedTuple

from gateway.parts.transfers.codes import Code, End, Outcome, code_of_source
from gateway.tags import Reason
from gateway.tags.transfer import TransferRule
from gateway.values import Value

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 30.0  # seconds before a write is tried again
LOOK_EVERY = 1.0  # seconds at most between two looks at the age of the source
_LOOKS = 8  # in the time of `stale`


class State(StrEnum):
    """The states of a row, for users."""

    STARTING = "starting"  # nothing was carried yet
    CARRIED = "carried"  # the target acknowledged the last value
    STALE = "stale"  # the source is bad, or its last read is too old
    WAITING = "waiting"  # the last write was not done, and is tried again
    REFUSED = "refused"  # the last write was not done, and the next change is carried
    UNCLEAR = "unclear"  # the last write may have been done; the next change is carried


_STATES = {
    End.DONE: State.CARRIED,
    End.NOT_DONE: State.WAITING,
    End.REFUSED: State.REFUSED,
    End.UNCLEAR: State.UNCLEAR,
}


class SourceReading(NamedTuple):
    """The source now. `value`: None if it is bad. `age`: seconds since the last read."""

    value: Value | None
    age: float
    reason: Reason | None = None
    detail: str = ""


class Carry(NamedTuple):
    """A write that is due. After `within` seconds it must not be sent any more."""

    value: Value  # of the source, or the substitute
    within: float
    substitute: bool = False


class Verdict(NamedTuple):
    """The state of a row with its code and a sentence. `code`: None if the manuals have none."""

    state: State
    code: Code | None
    why: str


class _Retry:
    """The pause before a write is tried again, which grows with each failure."""

    def __init__(self, now: float) -> None:
        self.at = now
        self._pause = FIRST_PAUSE

    def failed(self, now: float) -> None:
        self.at = now + self._pause
        self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def ended(self) -> None:
        self._pause = FIRST_PAUSE


class TransferRow:
    """The state of one transfer. Times in seconds of one clock."""

    def __init__(self, rule: TransferRule, now: float, *, fills: bool = False) -> None:
        """`fills`: the target is a value that a master reads, and turns bad with its source."""
        self.rule = rule
        self._fills = fills and rule.substitute is None
        self._lapsed = False  # the target was turned bad
        self.counts: Counter[End] = Counter()
        self.last: Outcome | None = None  # the end of the last write
        self.carried_at: float | None = None  # when the target acknowledged last
        self.writing: Carry | None = None
        self._seen: Value | None = None  # the last published value of the source
        self._wanted = False  # a change was not carried yet
        self._held: Value | None = None  # of the source, when the target acknowledged it
        self._good_at = now  # the last good read of the source; at the start: now
        self._substituted = False  # since the source became too old
        self._due = now
        self._next_change = now  # before that no change is carried
        self._retry = _Retry(now)

    def changed(self, value: Value) -> None:
        """Notes a good value of the source that was published."""
        if self._seen is None or value != self._seen:
            self._seen, self._wanted = value, True

    def target_online(self, now: float) -> None:
        """Tries a write again at once: the target replies."""
        if now < self._retry.at:
            self._next_change = now
        self._retry = _Retry(now)

    def next(self, source: SourceReading, now: float) -> Carry | None:
        """Returns the write that is due, which begins now; its end is reported to `ended`."""
        value = self._note_age(source, now)
        if self.writing is not None or now < self._retry.at:
            return None
        if value is None:
            self.writing = self._substitute(now)
        elif self._is_due(value, now):
            self.writing = Carry(value, self.rule.stale - source.age)
        return self.writing

    def lapse(self, source: SourceReading) -> Verdict | None:
        """Returns the state once, when the target must turn bad: it has an old value."""
        found = self.verdict(source)
        if not self._fills or self._lapsed or self.writing or found.state is not State.STALE:
            return None
        self._lapsed = True
        return found

    def _note_age(self, source: SourceReading, now: float) -> Value | None:
        """Returns the value if it may be carried."""
        if source.value is None or not source.age < self.rule.stale:
            return None
        self._good_at = now - source.age
        if self._substituted or self._lapsed:  # the target has no value of the source
            self._substituted = self._lapsed = False
            self._held = None
            self._want(now)
        return source.value

    def _want(self, at: float) -> None:
        """Lets the value be carried from `at` on, although it did not change."""
        if self.rule.every is None:
            self._wanted = True
        else:
            self._due = min(self._due, at)

    def _is_due(self, value: Value, now: float) -> bool:
        every = self.rule.every
        if every is not None:
            if now < self._due:
                return False
            self._due += every
            if self._due <= now:  # late: one write, not one for each interval
                self._due = now + every
            return True
        if not self._wanted or now < self._next_change:
            return False
        self._wanted = False
        if self._held is not None and value == self._held:
            return False
        self._next_change = now + self.rule.read_every
        return True

    def _substitute(self, now: float) -> Carry | None:
        value = self.rule.substitute
        if value is None or self._substituted or now < self._good_at + self.rule.stale:
            return None
        self._substituted = True
        return Carry(value, math.inf, substitute=True)

    def ended(self, outcome: Outcome, now: float) -> None:
        """Notes the end of the write."""
        carry, self.writing = self.writing, None
        if carry is None:
            raise AssertionError("no write is under way")
        self.last = outcome
        self.counts[outcome.end] += 1
        if outcome.end is End.NOT_DONE:
            self._again(carry, now)
            return
        self._retry.ended()
        if outcome.end is End.DONE:
            self.carried_at = now
        done = outcome.end is End.DONE and not carry.substitute
        self._held = carry.value if done else None

    def _again(self, carry: Carry, now: float) -> None:
        """The write was certainly not done: it is due again after a pause, if it still holds."""
        self._retry.failed(now)
        self._next_change = self._retry.at
        if carry.substitute:
            self._substituted = False
        else:
            self._want(self._retry.at)

    def wake(self, now: float) -> float:
        """Returns the time of the next look, if the source does not change before."""
        soon = now + min(LOOK_EVERY, self.rule.stale / _LOOKS)
        looks = self._wanted or self.rule.substitute is not None or self._fills
        if now < self._retry.at:  # the age of the source counts meanwhile
            return min(soon, self._retry.at) if looks else self._retry.at
        if self.rule.every is None:
            if self._wanted and now < self._next_change:
                return min(soon, self._next_change)
            return soon if looks else math.inf
        due = self._due if self._due > now else soon
        return min(due, soon) if looks else due

    def verdict(self, source: SourceReading) -> Verdict:
        """Returns the state of the row."""
        if source.value is None or not source.age < self.rule.stale:
            return self._stale(source)
        if self.last is None:
            return Verdict(State.STARTING, None, "")
        return Verdict(_STATES[self.last.end], self.last.code, self.last.why)

    def _stale(self, source: SourceReading) -> Verdict:
        name = self.rule.text[0]
        if source.value is not None:
            why = f"the last read of {name} is older than {self.rule.stale:g} s"
            return Verdict(State.STALE, Code.NO_RESPONSE, why)
        quality = "uncertain" if source.reason is Reason.OUT_OF_RANGE else "bad"
        why = f"{name} is {quality}: {source.reason}" if source.reason else f"{name} is bad"
        if source.detail:
            why += f" ({source.detail})"
        if self.last is None and source.reason is Reason.STARTING:
            return Verdict(State.STARTING, None, why)
        return Verdict(State.STALE, code_of_source(source.reason), why)
