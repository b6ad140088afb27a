"""Reads on demand: clients that wait for a sample that is younger than the latest one."""

import asyncio
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from gateway.engine.device.device import Device
from gateway.engine.jobs.poll_entry import PolledBlock
from gateway.errors import Busy
from gateway.line.line import Line
from gateway.tags import Quality, Sample, Tag
from gateway.tags.scan import Scan

FRESH_WITHIN = 5.0  # seconds that a client waits for a read on demand


class _Reader(NamedTuple):
    """A client that waits for a read that starts after `asked`, by the line's clock."""

    answer: asyncio.Future[Sample]
    asked: float


class OnDemand:
    """The waiting clients by tag. Several clients share one read."""

    def __init__(
        self,
        place: Callable[[str], tuple[Line, Device] | None],
        latest: Callable[[Tag], Sample],
    ) -> None:
        """`place` returns line and state of an enabled device, `latest` the sample of a tag."""
        self.waiting: dict[Tag, list[_Reader]] = {}
        # Tags that no poll reads and whose age is asked for: when their last sample arrived.
        self.arrived: dict[Tag, float] = {}
        self._place = place
        self._latest = latest

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """True if the last read is younger than `max_age` seconds, or no read is possible now.

        The age is monotonic time: a change of the system clock must not change it.
        """
        if tag.origin.inputs:
            return all(self.is_fresh(one, max_age) for one in tag.origin.inputs)
        place = self._place(tag.device)
        poll = self._poll(tag)
        if place is None or poll is None or not place[0].engine.is_open:
            return True
        if poll.reads.at is None or self._latest(tag).quality is Quality.BAD:
            return False
        return asyncio.get_running_loop().time() - poll.reads.at < max_age

    def age(self, tag: Tag) -> float:
        """Returns the seconds since the last good read, in monotonic time; infinite without one.

        The age of a value that no poll reads counts from its arrival, after the first call for it.
        """
        if tag.origin.inputs:
            return max(map(self.age, tag.origin.inputs))
        poll = self._poll(tag)
        if poll is None:
            at: float | None = self.arrived.setdefault(tag, -math.inf)
        else:
            at = poll.reads.at
        return math.inf if at is None else asyncio.get_running_loop().time() - at

    def note(self, samples: Sequence[Sample]) -> None:
        """Notes when values arrived that no poll reads."""
        now = asyncio.get_running_loop().time()
        tags = samples.tags if type(samples) is Scan else [sample.tag for sample in samples]
        for tag in tags:
            if tag in self.arrived:
                self.arrived[tag] = now

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """Returns the last sample if it `is_fresh`, otherwise that of the next read.

        The sample is bad if the device does not answer. Raises `Busy` if the line had no time for
        the read.
        """
        if tag.origin.inputs:
            await asyncio.gather(*(self.fresh(one, max_age) for one in tag.origin.inputs))
            return self._latest(tag)
        poll = self._poll(tag)
        if poll is None or self.is_fresh(tag, max_age):
            return self._latest(tag)
        reader = _Reader(asyncio.get_running_loop().create_future(), poll.asked)
        self.waiting.setdefault(tag, []).append(reader)
        self._expedite(tag)
        place = self._place(tag.device)
        longest = FRESH_WITHIN + (0.0 if place is None else place[0].dialling)
        try:
            async with asyncio.timeout(longest):
                return await reader.answer
        except TimeoutError:
            if self._latest(tag).quality is Quality.BAD:  # an offline device sends no sample
                return self._latest(tag)
            raise Busy(f"{tag.key} could not be read within {longest:g} s") from None
        finally:
            self.waiting[tag].remove(reader)
            if not self.waiting[tag]:
                del self.waiting[tag]

    def answer_all(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.tag in self.waiting:
                self.answer(sample)

    def answer(self, sample: Sample) -> None:
        """Answers waiting clients. A read that started before the request does not satisfy it."""
        tag = sample.tag
        poll = self._poll(tag)
        for reader in self.waiting[tag]:
            if reader.answer.done():
                continue
            if sample.quality is Quality.BAD or poll is None or poll.asked > reader.asked:
                reader.answer.set_result(self._latest(tag))
            else:
                self._expedite(tag)

    def changed(self, gone: Iterable[Tag]) -> None:
        """Ends the waiting for tags that a reload removed or changed; others are read again."""
        left = set(gone)
        for tag in left:
            self.arrived.pop(tag, None)
        for tag, readers in self.waiting.items():
            for reader in readers if tag in left else ():
                if not reader.answer.done():
                    reader.answer.set_exception(
                        Busy(f"the file was reloaded, and {tag.key} with it")
                    )
            if tag not in left:
                self._expedite(tag)

    def _poll(self, tag: Tag) -> PolledBlock | None:
        """Returns the poll that reads the tag; None if the value is unsolicited."""
        place = self._place(tag.device)
        return None if place is None else place[0].engine.reader(place[1], tag)

    def _expedite(self, tag: Tag) -> None:
        if (place := self._place(tag.device)) is not None:
            line, device = place
            line.expedite(device, tag)
