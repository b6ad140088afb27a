"""The last sample of every tag, and which samples are worth publishing."""

from collections.abc import Iterable

from gateway.tags import Publish, Quality, Reason, Sample, Tag, bad
from gateway.tags.unchanged import Unchanged


class Mirror:
    """What is known of every tag now, and what the network was last told.

    A sample is published when its quality or reason changed, when its value changed by at
    least the tag's deadband since the last published one, when the tag is published always,
    or when its heartbeat has run out.
    """

    def __init__(self, tags: Iterable[Tag], now: int) -> None:
        """`now`: nanoseconds since 1970."""
        self._current = {tag: bad(tag, Reason.STARTING, now) for tag in tags}
        self._published: dict[Tag, Sample] = {}
        # Those read again and again since, as they are: each with what knows its time now. Both in
        # one look-up, so that a thread that looks never takes the one for another's.
        self._unchanged: dict[Tag, tuple[Sample, Unchanged]] = {}

    def __getitem__(self, tag: Tag) -> Sample:
        known = self._unchanged.get(tag)
        if known is None:
            return self._current[tag]
        sample, unchanged = known
        return unchanged.now(sample)

    def samples(self) -> Iterable[Sample]:
        return map(self.__getitem__, self._current)

    def update(self, samples: Iterable[Sample]) -> list[Sample]:
        """Take the samples in; those worth publishing come back, in their order."""
        if type(samples) is Unchanged and self._goes_on(samples):
            return []
        current, published, good = self._current, self._published, Quality.GOOD
        unchanged = self._unchanged
        news = []
        for sample in samples:
            tag, value, quality, _, _, _ = sample
            if quality is not good and _same_trouble(current[tag], sample):
                continue  # it became bad then, not now
            current[tag] = sample  # first: a thread may look, and must find the one or the other
            if tag in unchanged:
                unchanged.pop(tag)[1].over = True
            told = published.get(tag)
            if told is not None and quality is told.quality is good:
                if told.value == value:
                    if tag.heartbeat is None and tag.publish is not Publish.ALWAYS:
                        continue  # as the last one: most samples end here
                elif tag.deadband is None:
                    published[tag] = sample
                    news.append(sample)
                    continue
            if _worth_telling(told, sample):
                published[tag] = sample
                news.append(sample)
        return news

    def told(self, samples: Iterable[Sample]) -> list[Sample]:
        """They are published once more, changed or not: a change counts from them. Those come
        back that are news, their value having moved by less than the deadband."""
        published = self._published
        news = []
        for sample in samples:
            before = published.get(sample.tag)
            published[sample.tag] = sample
            if before is not None and before.value != sample.value:
                news.append(sample)
        return news

    def _goes_on(self, unchanged: Unchanged) -> bool:
        """Whether these are what is known, so that nothing but their time is new."""
        if unchanged.over:
            return False
        known = self._unchanged.get(unchanged.samples[0].tag)
        if known is None or known[1] is not unchanged:
            if not all(self._is_known(sample) for sample in unchanged.samples):
                unchanged.over = True
                return False
            tags = [sample.tag for sample in unchanged.samples]
            self._unchanged |= {tag: (self._current[tag], unchanged) for tag in tags}
        return True

    def _is_known(self, sample: Sample) -> bool:
        known = self._current[sample.tag]
        return known is sample or (known.quality is Quality.BAD and _same_trouble(known, sample))


def _same_trouble(known: Sample, sample: Sample) -> bool:
    return known.quality is Quality.BAD and known.reason is sample.reason


def _worth_telling(told: Sample | None, sample: Sample) -> bool:
    if told is None or told.quality is not sample.quality or told.reason is not sample.reason:
        return True
    tag = sample.tag
    if tag.publish is Publish.ALWAYS:
        return True
    if tag.heartbeat is not None and not 0 <= sample.time - told.time < tag.heartbeat * 1e9:
        return True  # or the clock was set back: nobody knows how long ago that was
    return _changed(tag, told, sample)


def _changed(tag: Tag, told: Sample, sample: Sample) -> bool:
    old, new = told.value, sample.value
    if tag.deadband is None or old is None or new is None:
        return old != new
    if isinstance(old, (bool, str)) or isinstance(new, (bool, str)):
        return old != new
    band = tag.deadband.amount
    if tag.deadband.percent:
        band = abs(old) * band / 100
    return old != new and abs(new - old) >= band
