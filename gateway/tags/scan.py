"""Decodes the reads of a block: only what changed, and makes samples only where they are needed."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import compress
from operator import call, itemgetter, ne
from typing import Any, overload

from gateway.tags.alarm import AlarmRule
from gateway.tags.numbers import numbers
from gateway.tags.publishing import Publish
from gateway.tags.sample import Quality, Reason, Sample, bad, of_field, uncertain
from gateway.tags.tag import Tag
from gateway.values import Value

Failures = Mapping[int, Sample]  # bad samples by place: the units there hold no value
NO_FAILURES: Failures = {}
_NOWHERE = frozenset[int]()


class Latest:
    """The latest scan of one block in the mirror.

    The mirror replaces `scan` in one step, so another thread never combines a value with the time
    of another read. `superseded` becomes True when another sample of one of the tags arrives; the
    next read of the block is then compared with nothing.
    """

    __slots__ = ("alarmed", "by_rule", "in_use", "named", "scan", "superseded", "unasked")

    def __init__(self) -> None:
        self.scan: Scan
        self.in_use = False  # the mirror finds the samples of the tags here
        self.superseded = False
        self.by_rule: Collection[int] = ()  # places of tags with a deadband, a heartbeat ...
        self.unasked: Collection[int] = ()  # of these, tags that are published without a change
        self.alarmed: Collection[int] | None = None  # places of tags with an alarm; None: not known
        self.named: frozenset[int] = _NOWHERE  # places whose documents have more than a value

    def adopt(self, scan: "Scan") -> None:
        """Begins with a scan."""
        places = tuple(enumerate(scan.tags))
        rules = [(place, tag.publishing) for place, tag in places]
        eager = [p for p, rule in rules if rule.heartbeat or rule.publish is Publish.ALWAYS]
        self.by_rule = frozenset(eager).union(p for p, rule in rules if rule.deadband is not None)
        self.unasked = tuple(eager)
        self.alarmed = tuple(p for p, tag in places if tag.feature(AlarmRule) is not None)
        self.named = frozenset(p for p, tag in places if not (tag.is_plain and tag.is_scalar))
        self.scan, self.in_use = scan, True


class Samples(Sequence[Sample]):
    """The samples of some places of a read. They are made when the first one is taken."""

    __slots__ = ("_failures", "_made", "_named", "_outside", "_places", "_tags", "_values", "time")

    def __init__(self, scan: "Scan", places: Sequence[int]) -> None:
        self._tags, self._values, self._failures = scan.tags, scan.values, scan.failures
        self.time = scan.time  # an equal read moves that of the scan
        self._outside, self._named = scan.outside, scan.latest.named
        self._places = places
        self._made: list[Sample] | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self._all())

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        return self._all()[index]

    @property
    def tags(self) -> Sequence[Tag]:
        tags, places = self._tags, self._places
        return tags if len(places) == len(tags) else [tags[place] for place in places]

    def plain(self) -> tuple[list[Value | None], list[int]]:
        """Returns the values, and the numbers of those that are more than a plain good one: None
        is in their place."""
        values, special = self._values, self._named
        if self._failures or self._outside:
            special = special.union(self._failures, self._outside)
        if not special:
            return [values[place] for place in self._places], []
        found = [None if place in special else values[place] for place in self._places]
        return found, [number for number, place in enumerate(self._places) if place in special]

    def _all(self) -> list[Sample]:
        if self._made is None:
            tags, values, time = self._tags, self._values, self.time
            good, new = Quality.GOOD, tuple.__new__  # twice as fast as the constructor
            self._made = [
                self._failures[place]
                if (value := values[place]) is None
                else new(Sample, (tags[place], value, good, time, None, ""))
                for place in self._places
            ]
            if self._outside:
                self._made = [
                    uncertain(sample) if place in self._outside else sample
                    for place, sample in zip(self._places, self._made, strict=True)
                ]
        return self._made


class Scan(Sequence[Sample]):
    """One read of a block: a value for each tag, and one time.

    `time` (nanoseconds since 1970) is the latest read; a read of equal units only moves it. A bad
    sample keeps the time when it became bad. `outside`: the places of uncertain values.
    """

    __slots__ = ("failures", "keys", "latest", "outside", "tags", "time", "units", "values")

    def __init__(
        self,
        tags: Sequence[Tag],
        units: Sequence[Any],
        keys: Sequence[Any],
        values: Sequence[Value | None],
        failures: Failures,
        time: int,
        latest: Latest,
    ) -> None:
        """`keys`: the unit or units of each tag."""
        self.tags = tags
        self.units = units
        self.keys = keys
        self.values = values
        self.failures = failures
        self.time = time
        self.latest = latest
        self.outside = _NOWHERE

    def __len__(self) -> int:
        return len(self.tags)

    def __iter__(self) -> Iterator[Sample]:
        return iter(Samples(self, range(len(self.tags))))

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return list(self)[index]
        value = self.values[index]
        if value is None:
            return self.failures[index]
        sample = Sample(self.tags[index], value, Quality.GOOD, self.time)
        return uncertain(sample) if index in self.outside else sample


class Decoder:
    """Makes the scans of one block."""

    __slots__ = ("_begins", "_checks", "_convert", "_keys", "_places", "_plain", "_tags")

    def __init__(self, tags: Sequence[Tag], begins: Sequence[int]) -> None:
        """`begins`: for each tag the place of its first unit in the reply."""
        self._tags = tags
        self._begins = begins
        self._places = range(len(tags))
        self._convert = tuple(tag.convert for tag in tags)
        checks = ((place, tag.range_check()) for place, tag in enumerate(tags))
        self._checks = [(place, check) for place, check in checks if check is not None]
        self._keys: Callable[[Sequence[Any]], Sequence[Any]]
        self._plain = False  # the keys are the values
        found = None if self._checks else numbers(tags, begins)
        if found is not None:
            self._keys, converts = found
            self._plain = converts is None
            self._convert = () if converts is None else tuple(converts)
            return
        self._keys = itemgetter(
            *(
                begin if tag.single else slice(begin, begin + tag.span.size)
                for tag, begin in zip(tags, begins, strict=True)
            ),
            *((slice(0),) if len(tags) == 1 else ()),  # else it would return no tuple
        )

    def first(self, units: Sequence[Any], time: int) -> Scan:
        """Decodes all units; `time` is the arrival of the reply (ns since 1970)."""
        keys = self._keys(units)
        if self._plain:
            return Scan(self._tags, units, keys, keys, NO_FAILURES, time, Latest())
        values = list(map(call, self._convert, keys))
        failures = self._failures(values, NO_FAILURES, time)
        return self._checked(Scan(self._tags, units, keys, values, failures, time, Latest()))

    def after(self, before: Scan, units: Sequence[Any], time: int) -> Scan:
        """Decodes the units that are not those of the read before."""
        keys, convert = self._keys(units), self._convert
        if self._plain:
            return Scan(self._tags, units, keys, keys, NO_FAILURES, time, before.latest)
        changed = list(map(ne, keys, before.keys))
        new = list(map(call, compress(convert, changed), compress(keys, changed)))
        failures = before.failures
        if len(new) == len(convert):
            values = new
        else:
            values = list(before.values)
            for place, value in zip(compress(self._places, changed), new, strict=True):
                values[place] = value
        if failures or None in new:
            failures = self._failures(values, failures, time)
        scan = Scan(self._tags, units, keys, values, failures, time, before.latest)
        return self._checked(scan)

    def fields(self, units: Sequence[Any], time: int) -> list[Sample]:
        """Returns the samples of a frame: its fields are values, not words."""
        parts = zip(self._tags, self._begins, strict=True)
        return [of_field(tag, units[begin], time) for tag, begin in parts]

    def _checked(self, scan: Scan) -> Scan:
        if self._checks:
            keys = scan.keys
            outside = (place for place, is_outside in self._checks if is_outside(keys[place]))
            scan.outside = frozenset(outside)
        return scan

    def _failures(self, values: Sequence[Value | None], before: Failures, time: int) -> Failures:
        """Returns a bad sample for each place without a value. One that is bad already stays."""
        if None not in values:
            return NO_FAILURES
        places = (place for place, value in enumerate(values) if value is None)
        return {
            place: before.get(place) or bad(self._tags[place], Reason.NOT_A_NUMBER, time)
            for place in places
        }
