"""The last sample of every tag, and which samples are worth publishing."""

from collections.abc import Iterable

from gateway.tags import Publish, Quality, Reason, Sample, Tag, bad


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

    def __getitem__(self, tag: Tag) -> Sample:
        return self._current[tag]

    def samples(self) -> Iterable[Sample]:
        return self._current.values()

    def update(self, samples: Iterable[Sample]) -> list[Sample]:
        """Take the samples in; those worth publishing come back, in their order."""
        current, published, good = self._current, self._published, Quality.GOOD
        news = []
        for sample in samples:
            tag, value, quality, _, _, _ = sample
            if quality is not good and _same_trouble(current[tag], sample):
                continue  # it became bad then, not now
            current[tag] = sample
            told = published.get(tag)
            if (
                told is not None
                and told.value == value
                and quality is told.quality is good
                and tag.heartbeat is None
                and tag.publish is not Publish.ALWAYS
            ):
                continue  # as the last one: most samples end here
            if _worth_telling(told, sample):
                published[tag] = sample
                news.append(sample)
        return news


def _same_trouble(known: Sample, sample: Sample) -> bool:
    return known.quality is Quality.BAD and known.reason is sample.reason


def _worth_telling(told: Sample | None, sample: Sample) -> bool:
    if told is None or told.quality is not sample.quality or told.reason is not sample.reason:
        return True
    tag = sample.tag
    if tag.publish is Publish.ALWAYS:
        return True
    if tag.heartbeat is not None and sample.time - told.time >= tag.heartbeat * 1e9:
        return True
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
