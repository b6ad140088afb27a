"""The latest sample of every tag, and the choice of samples to publish."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import compress, count
from operator import ne
from typing import Any, NamedTuple

from gateway.tags import Deadband, Publish, Quality, Reason, Sample, Tag, bad
from gateway.tags.computed import Dependents, computed
from gateway.tags.kept import Counted, CounterState, kept, memory_of
from gateway.tags.scan import Latest, Samples, Scan
from gateway.values.numerals import are_apart


class _InScan(NamedTuple):
    """The place of a tag's latest sample in the latest scan of its block."""

    latest: Latest
    place: int


class Mirror:
    """The latest and the last published sample of every tag.

    A sample is published when its quality or reason changed, when its value changed by at
    least the tag's deadband since the last published one, when the tag is published always,
    or when its heartbeat interval has passed.
    """

    def __init__(self, tags: Iterable[Tag], now: int) -> None:
        """`now`: nanoseconds since 1970."""
        # The latest sample; None: nothing was read.
        self._current: dict[Tag, Sample | _InScan | None] = dict.fromkeys(tags)
        self._dependents = Dependents(self._current)
        self.derives = bool(self._dependents)
        self.memories = {
            tag: memory_of(tag) for tag in self._current if tag.origin.kept is not None
        }
        self.pending: set[Tag] = set()  # kept tags whose value an equal read can change
        self._raw = {tag.origin.inputs[0] for tag in self.memories}
        self._current |= dict.fromkeys(self._raw)
        # Not of a tag in a scan whose changes are all published.
        self._published: dict[Tag, Sample] = {}
        self._begun, self._first = False, now

    def begin(self, now: int) -> None:
        """Gives the first samples another time, once. Call it before the lines begin.

        A client keeps the later of two samples. With the time of the creation of this mirror it
        would keep the last value of the gateway that was active before.
        """
        if not self._begun:
            self._begun, self._first = True, now

    def __getitem__(self, tag: Tag) -> Sample:
        current = self._current[tag]
        if isinstance(current, _InScan):
            return current.latest.scan[current.place]
        sample = self._stored(tag, current)
        return self._derived(tag, sample) if tag.origin.inputs else sample

    def _stored(self, tag: Tag, current: Sample | _InScan | None) -> Sample:
        if isinstance(current, Sample):
            return current
        return bad(tag, Reason.STARTING, self._first) if current is None else self[tag]

    def samples(self) -> Iterable[Sample]:
        return (self[tag] for tag in self._current if tag not in self._raw)

    def update(self, samples: Iterable[Sample]) -> Sequence[Sample]:
        """Stores the samples. Returns those to publish, in their order."""
        if type(samples) is Scan and samples.latest.in_use:
            return self._renew(samples.latest, samples)
        to_publish = self._store(samples)
        if type(samples) is Scan and not samples.latest.superseded:
            self._adopt(samples.latest, samples)
        return to_publish

    def counters(self) -> dict[str, CounterState]:
        """Returns the states of all counters that were read, by name and address.

        With another address a total begins again: the step between two counters is no count.
        """
        known = ((_place(tag), memory) for tag, memory in self.memories.items())
        return {
            key: memory.state
            for key, memory in known
            if isinstance(memory, Counted) and memory.state is not None
        }

    def restore(self, counters: Mapping[str, CounterState]) -> None:
        """Goes on with the totals of an earlier gateway. Reads are missing since then."""
        for tag, memory in self.memories.items():
            if isinstance(memory, Counted) and (state := counters.get(_place(tag))) is not None:
                memory.state, memory.gap = state, True

    def follow(self, samples: Sequence[Sample]) -> list[Sample]:
        """Derives the values that follow from samples to publish. Returns all to publish.

        The raw reads of kept values are not published.
        """
        due = [sample for sample in samples if sample.tag not in self._raw]
        changed = [sample.tag for sample in samples]
        for tag in self._dependents.after(changed, self.pending):
            due += self._store([self._derive(tag)])
        return due

    def _derive(self, tag: Tag) -> Sample:
        memory = self.memories.get(tag)
        if memory is None:
            return computed(tag, self.__getitem__)
        sample = kept(tag, memory, self[tag.origin.inputs[0]])
        (self.pending.add if memory.pending else self.pending.discard)(tag)
        return sample

    def _derived(self, tag: Tag, current: Sample) -> Sample:
        """Returns the present sample of a derived tag: a read of equal inputs moves its time.

        It changes no memory: several threads call it.
        """
        if current.reason is Reason.DISABLED:
            return current
        if tag.origin.kept is not None:
            raw = self[tag.origin.inputs[0]]
            both_good = raw.quality is current.quality is Quality.GOOD
            return current._replace(time=raw.time) if both_good else current
        try:
            sample = computed(tag, self.__getitem__)
        except KeyError:  # a reload is replacing an input: this tag follows at its end
            return bad(tag, Reason.STARTING, current.time)
        bad_before = sample.quality is Quality.BAD and _same_failure(current, sample)
        return current if bad_before else sample

    def mark_published(self, samples: Iterable[Sample]) -> list[Sample]:
        """Records samples that are published again: deadband and heartbeat count from them.

        Returns those whose value differs from the last published one by less than the deadband.
        """
        changed = []
        for sample in samples:
            if self._current.get(sample.tag) is None or self._publishes_all(sample.tag):
                continue  # the next one is published in any case
            last = self._published.get(sample.tag)
            self._published[sample.tag] = sample
            if last is not None and last.value != sample.value:
                changed.append(sample)
        return changed

    def add(self, samples: Iterable[Sample], renewed: Mapping[Tag, Tag]) -> None:
        """Adds tags with their first samples, which are published. `renewed`: old tags to those
        that go on with their samples."""
        for sample in samples:
            self._current[sample.tag] = self._published[sample.tag] = sample
        for old, new in renewed.items():
            latest = self._current[new] = self[old]._replace(tag=new)
            last = latest if self._publishes_all(old) else self._published.get(old)
            if last is not None:
                self._published[new] = last._replace(tag=new)

    def compute(self, first: Iterable[Sample], gone: Iterable[Tag]) -> list[Sample]:
        """Has other computed tags. `first`: the samples of those that are new. Returns all that
        are to be published; a tag of a disabled device is disabled too."""
        due = []
        for sample in first:
            self._current[sample.tag] = sample
            if sample.reason is Reason.DISABLED:
                self._published[sample.tag] = sample
                due.append(sample)
        self.forget(gone)
        self._dependents = Dependents(self._current)
        self.derives = bool(self._dependents)
        begun = {sample.tag for sample in first} - {sample.tag for sample in due}
        for tag in self._dependents.after((), begun):
            due += self._store([computed(tag, self.__getitem__)])
        return due

    def forget(self, tags: Iterable[Tag]) -> None:
        """Removes tags. Other threads must not look them up any more."""
        for tag in tags:
            current = self._current.get(tag)
            if isinstance(current, _InScan):
                self._supersede(current.latest)
            self._current.pop(tag, None)
            self._published.pop(tag, None)

    def _publishes_all(self, tag: Tag) -> bool:
        """True if each change of the tag is published: the last published sample is the latest."""
        entry = self._current.get(tag)
        return isinstance(entry, _InScan) and entry.place not in entry.latest.by_rule

    def _store(self, samples: Iterable[Sample]) -> list[Sample]:
        current, published = self._current, self._published
        to_publish = []
        for sample in samples:
            tag = sample.tag
            before = current.get(tag)
            if isinstance(before, _InScan):
                self._supersede(before.latest)
                before = current[tag]
            if sample.quality is Quality.BAD and _same_failure(self._stored(tag, before), sample):
                continue  # keeps the time when it became bad
            current[tag] = sample
            if _is_due(published.get(tag), sample):
                published[tag] = sample
                to_publish.append(sample)
        return to_publish

    def _adopt(self, latest: Latest, scan: Scan) -> None:
        """Finds the samples of these tags in the scan from now on. They were stored already."""
        tags = scan.tags
        scan.failures = {place: self[tags[place]] for place in scan.failures}
        latest.adopt(scan)
        for place, tag in enumerate(tags):
            self._current[tag] = _InScan(latest, place)
            if place not in latest.by_rule:
                self._published.pop(tag, None)

    def _renew(self, latest: Latest, scan: Scan) -> Sequence[Sample]:
        """Replaces the scan of a block by the next one. Returns the samples to publish."""
        before, latest.scan = latest.scan, scan
        changed: Sequence[int] = ()
        if scan.values is not before.values:
            changed = list(compress(count(), map(ne, scan.values, before.values)))
        if scan.outside != before.outside:
            changed = sorted({*changed, *(scan.outside ^ before.outside)})
        if latest.by_rule:
            changed = self._due(latest, before, changed)
        return Samples(scan, changed) if changed else ()

    def _due(self, latest: Latest, before: Scan, changed: Sequence[int]) -> list[int]:
        """Returns the places to publish, after the rules of their tags."""
        scan, published, due = latest.scan, self._published, []
        for place in sorted({*changed, *latest.unasked}):
            if place in latest.by_rule:
                if scan.values[place] is before.values[place] is None:
                    continue  # still bad
                sample = scan[place]
                if not _is_due(published.get(sample.tag), sample):
                    continue
                published[sample.tag] = sample
            due.append(place)
        return due

    def _supersede(self, latest: Latest) -> None:
        """Takes the samples out of a scan: one of its tags got another sample."""
        latest.superseded, latest.in_use = True, False
        for place, sample in enumerate(latest.scan):
            self._current[sample.tag] = sample  # in one step: other threads find it or the scan
            if place not in latest.by_rule:
                self._published[sample.tag] = sample


def _place(tag: Tag) -> str:
    return f"{tag.key} {tag.text}"


def _same_failure(current: Sample, sample: Sample) -> bool:
    return current.quality is Quality.BAD and current.reason is sample.reason


def _is_due(last: Sample | None, sample: Sample) -> bool:
    if last is None or last.quality is not sample.quality or last.reason is not sample.reason:
        return True
    tag = sample.tag
    rule = tag.publishing
    if rule.publish is Publish.ALWAYS:
        return True
    if rule.heartbeat is not None and not 0 <= sample.time - last.time < rule.heartbeat * 1e9:
        return True  # also after the clock was set back: the interval is then unknown
    old, new, band = last.value, sample.value, rule.deadband
    if band is None or old is None or new is None:
        return old != new
    if not tag.layout.type.count:
        return _moved(band, old, new)
    return any(_moved(band, *pair) for pair in zip(old, new, strict=True))  # type: ignore[arg-type]


def _moved(band: Deadband, old: Any, new: Any) -> bool:
    """Returns True if a value moved by the deadband; a text or a bit, if it is another one."""
    if isinstance(old, (bool, str)) or isinstance(new, (bool, str)):
        return bool(old != new)
    return old != new and are_apart(old, new, band.amount, percent=band.percent)
