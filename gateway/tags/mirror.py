"""The latest sample of every tag, and the choice of samples to publish."""

from collections.abc import Iterable

from gateway.tags import Publish, Quality, Reason, Sample, Tag, bad
from gateway.tags.unchanged import Unchanged


class Mirror:
    """The latest and the last published sample of every tag.

    A sample is published when its quality or reason changed, when its value changed by at
    least the tag's deadband since the last published one, when the tag is published always,
    or when its heartbeat interval has passed.
    """

    def __init__(self, tags: Iterable[Tag], now: int) -> None:
        """`now`: nanoseconds since 1970."""
        self._current = {tag: bad(tag, Reason.STARTING, now) for tag in tags}
        self._published: dict[Tag, Sample] = {}
        self._begun = False
        # Tags of repeated equal reads. Sample and `Unchanged` are in one entry: another thread gets
        # both by one look-up and never combines a value with the time of another.
        self._unchanged: dict[Tag, tuple[Sample, Unchanged]] = {}

    def begin(self, now: int) -> None:
        """Gives the first samples another time, once. Call it before the lines begin.

        A client keeps the later of two samples. With the time of the creation of this mirror it
        would keep the last value of the gateway that was active before.
        """
        if not self._begun:
            self._begun = True
            self._current = {tag: s._replace(time=now) for tag, s in self._current.items()}

    def __getitem__(self, tag: Tag) -> Sample:
        entry = self._unchanged.get(tag)
        if entry is None:
            return self._current[tag]
        sample, unchanged = entry
        return unchanged.restamped(sample)

    def samples(self) -> Iterable[Sample]:
        return map(self.__getitem__, self._current)

    def update(self, samples: Iterable[Sample]) -> list[Sample]:
        """Stores the samples. Returns those to publish, in their order."""
        if type(samples) is Unchanged and self._adopt(samples):
            return []
        current, published, good = self._current, self._published, Quality.GOOD
        unchanged = self._unchanged
        to_publish = []
        for sample in samples:
            tag, value, quality, _, _, _ = sample
            if quality is not good and _same_failure(current[tag], sample):
                continue  # keeps the time when it became bad
            # Before the entry of `unchanged` goes: other threads must find one or the other.
            current[tag] = sample
            if tag in unchanged:
                unchanged.pop(tag)[1].superseded = True
            last = published.get(tag)
            if last is not None and quality is last.quality is good:
                if last.value == value:
                    if tag.heartbeat is None and tag.publish is not Publish.ALWAYS:
                        continue  # most samples end here
                elif tag.deadband is None:
                    published[tag] = sample
                    to_publish.append(sample)
                    continue
            if _is_due(last, sample):
                published[tag] = sample
                to_publish.append(sample)
        return to_publish

    def mark_published(self, samples: Iterable[Sample]) -> list[Sample]:
        """Records samples that are published again: deadband and heartbeat count from them.

        Returns those whose value differs from the last published one by less than the deadband.
        """
        published = self._published
        changed = []
        for sample in samples:
            last = published.get(sample.tag)
            published[sample.tag] = sample
            if last is not None and last.value != sample.value:
                changed.append(sample)
        return changed

    def _adopt(self, unchanged: Unchanged) -> bool:
        """Returns True when the values are the current ones, so that only the time is new."""
        if unchanged.superseded:
            return False
        entry = self._unchanged.get(unchanged.samples[0].tag)
        if entry is None or entry[1] is not unchanged:
            if not all(self._is_current(sample) for sample in unchanged.samples):
                unchanged.superseded = True
                return False
            tags = [sample.tag for sample in unchanged.samples]
            self._unchanged |= {tag: (self._current[tag], unchanged) for tag in tags}
        return True

    def _is_current(self, sample: Sample) -> bool:
        current = self._current[sample.tag]
        return current is sample or (
            current.quality is Quality.BAD and _same_failure(current, sample)
        )


def _same_failure(current: Sample, sample: Sample) -> bool:
    return current.quality is Quality.BAD and current.reason is sample.reason


def _is_due(last: Sample | None, sample: Sample) -> bool:
    if last is None or last.quality is not sample.quality or last.reason is not sample.reason:
        return True
    tag = sample.tag
    if tag.publish is Publish.ALWAYS:
        return True
    if tag.heartbeat is not None and not 0 <= sample.time - last.time < tag.heartbeat * 1e9:
        return True  # also after the clock was set back: the interval is then unknown
    return _changed(tag, last, sample)


def _changed(tag: Tag, last: Sample, sample: Sample) -> bool:
    old, new = last.value, sample.value
    if tag.deadband is None or old is None or new is None:
        return old != new
    if isinstance(old, (bool, str)) or isinstance(new, (bool, str)):
        return old != new
    band = tag.deadband.amount
    if tag.deadband.percent:
        band = abs(old) * band / 100
    return old != new and abs(new - old) >= band
