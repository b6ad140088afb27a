"""Samples of computed tags, made of the samples of their inputs."""

from collections.abc import Callable, Iterable, Sequence

from gateway.tags.sample import Quality, Reason, Sample, bad, converted, uncertain
from gateway.tags.tag import Tag


def computed(tag: Tag, sample_of: Callable[[Tag], Sample]) -> Sample:
    """Returns the sample of a computed tag. It is bad, or uncertain, if an input is.

    Its time is that of the newest input: a value that follows from another is never older.
    """
    inputs = [sample_of(one) for one in tag.origin.inputs]
    for sample in inputs:
        if sample.quality is Quality.BAD:
            return bad(tag, sample.reason or Reason.NOT_A_NUMBER, sample.time, _why(tag, sample))
    time = max(sample.time for sample in inputs)
    try:
        found = converted(tag, [sample.value for sample in inputs], time)
    except ArithmeticError as error:
        return bad(tag, Reason.NOT_A_NUMBER, time, str(error))
    doubtful = next((one for one in inputs if one.quality is Quality.UNCERTAIN), None)
    if doubtful is None or found.quality is Quality.BAD:
        return found
    return uncertain(found, _why(tag, doubtful))


def _why(tag: Tag, given: Sample) -> str:
    name = given.tag.name if given.tag.device == tag.device else given.tag.key
    why = f"input {name} is {given.quality}"
    return f"{why}: {given.detail}" if given.detail else why


class Dependents:
    """The tags whose values are derived from each tag: computed, or kept over several reads."""

    def __init__(self, tags: Iterable[Tag]) -> None:
        """`tags`: in any order; `after` has each tag after its inputs."""
        self._order: dict[Tag, int] = {}  # a tag comes after its inputs
        self._of: dict[Tag, set[Tag]] = {}  # directly
        for tag in tags:
            self._add(tag)

    def _add(self, tag: Tag) -> None:
        if not tag.origin.inputs or tag in self._order:
            return
        for one in tag.origin.inputs:
            self._add(one)
            self._of.setdefault(one, set()).add(tag)
        self._order[tag] = len(self._order)

    def __bool__(self) -> bool:
        return bool(self._order)

    def after(self, changed: Iterable[Tag], also: Iterable[Tag] = ()) -> Sequence[Tag]:
        """Returns `also`, and the tags that follow from all these, each after its inputs."""
        found = set(also)
        waiting = [*changed, *found]
        while waiting:
            new = self._of.get(waiting.pop(), set()) - found
            found |= new
            waiting += new
        return self.in_order(found)

    def in_order(self, tags: Iterable[Tag]) -> Sequence[Tag]:
        """Returns computed tags, each after its inputs."""
        return sorted(tags, key=self._order.__getitem__)
