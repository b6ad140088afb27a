"""Values that follow from several reads: a bit that must stay, and the total of a counter.

Each has settings, and a memory that changes with every read. Times are those of samples.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from gateway.tags.sample import Quality, Reason, Sample, bad, good
from gateway.tags.tag import Tag
from gateway.values import Value


class CounterState(NamedTuple):
    """The last count of the device, and the total."""

    last: int
    total: int


@dataclass(slots=True)
class Debounced:
    """A bit changes after it had the new value for `stay` nanoseconds."""

    stay: int
    shown: Value | None = None
    since: int | None = None  # the first read with another value than the shown one

    @property
    def pending(self) -> bool:
        """True if an equal read can change the value."""
        return self.since is not None

    def lost(self) -> None:
        """Forgets all after a bad read: the next value counts at once."""
        self.shown = self.since = None

    def read(self, value: Value, time: int) -> Value:
        if self.shown is None or value == self.shown:
            self.shown, self.since = value, None
        elif self.since is None or time < self.since:  # also after the clock was set back
            self.since = time
        elif time - self.since >= self.stay:
            self.shown, self.since = value, None
        return self.shown


@dataclass(slots=True)
class Counted:
    """The total of a counter that begins again at 0 after `modulus` - 1.

    A step of more than `most` is no count: the counter was set or cleared. After a gap in the reads
    the counter may have been cleared and have counted on, so going back is no count either.
    """

    modulus: int
    most: int
    state: CounterState | None = None
    gap: bool = False  # reads are missing since `state`

    pending = False

    def lost(self) -> None:
        """Notes that reads are missing."""
        self.gap = True

    def read(self, value: Any, time: int) -> Value:
        """`value`: a whole number; the configuration refuses other types."""
        count = int(value) % self.modulus
        last, total = self.state or CounterState(count, count)
        step = (count - last) % self.modulus
        back = count < last
        if (self.gap and back) or (step > self.most and (back or not self.gap)):
            step = 0
        self.state, self.gap = CounterState(count, total + step), False
        return self.state.total


Memory = Debounced | Counted


def memory_of(tag: Tag) -> Memory:
    """Returns a memory without any read."""
    rule = tag.origin.kept
    if isinstance(rule, float):
        return Debounced(round(rule * 1e9))
    return Counted(*rule) if rule is not None else Debounced(0)


def kept(tag: Tag, memory: Memory, raw: Sample) -> Sample:
    """Returns the sample of the tag after a read of its raw value. A bad one passes at once."""
    if raw.quality is Quality.BAD or raw.value is None:
        memory.lost()
        return raw._replace(tag=tag)
    value = tag.convert(memory.read(raw.value, raw.time))
    if value is None:  # beyond the range of its type
        return bad(tag, Reason.NOT_A_NUMBER, raw.time)
    return good(tag, value, raw.time)
