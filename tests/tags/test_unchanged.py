"""Repeated equal reads: only the time moves, and no change is missed."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import pytest

from gateway.engine.effects import Effect, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs import (
    Poll,
    Probe,
    Result,
    Resynced,
    Settle,
    Settled,
    Traffic,
    Transacted,
)
from gateway.errors import NoReply
from gateway.tags import Publish, Quality, Reason, Sample, Tag, bad, good
from gateway.tags.mirror import Mirror
from gateway.tags.unchanged import Unchanged
from tests.sim.bench import WIRE
from tests.sim.plant import device, make_tag


class Reader:
    """An engine with one device, read into a mirror step by step, once a second."""

    def __init__(self, *tags: Tag) -> None:
        self.device = device(list(tags))
        self.engine = Engine("line", [self.device], WIRE)
        self.mirror = Mirror(tags, 0)
        self.time = 0
        self.published: list[Sample] = []
        self.samples: Sequence[Sample] = ()
        self.take(self.engine.opened(0.0))

    def take(self, effects: Sequence[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Samples):
                self.samples = effect.samples
                self.published = self.mirror.update(effect.samples)

    def next(self) -> Poll:
        """Returns the poll of the block. Answers the probes before it."""
        now = float(self.time)
        self.engine.expedite(self.device, self.device.tags[0])
        job = self.engine.next(now)
        while isinstance(job, Probe):
            self.conclude(job, Resynced(99))
            self.engine.expedite(self.device, self.device.tags[0])
            job = self.engine.next(now)
        assert isinstance(job, Poll)
        return job

    def conclude(self, job: Transacted, result: Result) -> None:
        self.take(self.engine.conclude(job, result, Traffic(), float(self.time), self.time))

    def read(self, *units: int) -> None:
        self.time += 1
        self.conclude(self.next(), units)

    def fail(self) -> None:
        """One poll without a reply."""
        self.time += 1
        self.conclude(self.next(), NoReply("no reply"))
        settle = self.engine.next(float(self.time))
        assert isinstance(settle, Settle)
        self.conclude(settle, Settled(None))


TWO = ("D0", "D1")


def test_the_third_equal_read_only_moves_the_time() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(3):
        reader.read(7, 8)
    assert isinstance(reader.samples, Unchanged)
    assert reader.published == []
    assert [reader.mirror[a], reader.mirror[b]] == [good(a, 7, 3), good(b, 8, 3)]
    assert list(reader.mirror.samples()) == [good(a, 7, 3), good(b, 8, 3)]
    assert list(reader.samples) == [good(a, 7, 3), good(b, 8, 3)]
    assert reader.samples[1:] == [good(b, 8, 3)]


def test_a_change_after_any_number_of_equal_reads_is_published() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for count in range(5):
        for _ in range(count):
            reader.read(7, 8)
        reader.read(7, count)
        assert reader.mirror[b] == good(b, count, reader.time)
        assert reader.published[-1] == good(b, count, reader.time)
        assert reader.mirror[a] == good(a, 7, reader.time)


@pytest.mark.parametrize("before", [1, 2, 3])
def test_a_bad_value_becomes_good_again_with_equal_words(
    before: int,
) -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(before):
        reader.read(7, 8)
    reader.mirror.update([bad(b, Reason.NO_REPLY, before)])
    assert reader.mirror[b].quality is Quality.BAD
    assert reader.mirror[a] == good(a, 7, before)
    for _ in range(3):
        reader.read(7, 8)
        assert reader.mirror[b] == good(b, 8, reader.time)
        assert reader.mirror[a] == good(a, 7, reader.time)


def test_another_value_in_between_is_replaced() -> None:
    """From another block with the tag, or from an unsolicited frame."""
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for before in (1, 2, 3):
        for _ in range(before):
            reader.read(7, 8)
        reader.mirror.update([good(a, 666, reader.time)])
        for _ in range(2):
            reader.read(7, 8)
            assert reader.mirror[a] == good(a, 7, reader.time)
            assert reader.mirror[b] == good(b, 8, reader.time)


def test_words_without_a_value_keep_the_time_they_became_bad() -> None:
    nan = make_tag("D0", type="float32")
    number = make_tag("D2")
    reader = Reader(nan, number)
    for _ in range(4):
        reader.read(0, 0x7FC0, 5)
    assert reader.mirror[nan] == bad(nan, Reason.NOT_A_NUMBER, 1)
    assert reader.mirror[number] == good(number, 5, 4)
    reader.read(0, 0x3F80, 5)
    assert reader.mirror[nan] == good(nan, 1.0, 5)


@pytest.mark.parametrize("settings", [{"publish": Publish.ALWAYS}, {"heartbeat": 2e-9}])
def test_heartbeat_and_always_publish_equal_reads(settings: dict[str, Any]) -> None:
    eager, quiet = make_tag("D0", **settings), make_tag("D1")
    reader = Reader(eager, quiet)
    published = []
    for _ in range(9):
        reader.read(7, 8)
        published += [sample.time for sample in reader.published if sample.tag is eager]
    assert published == (list(range(1, 10)) if "publish" in settings else [1, 3, 5, 7, 9])


def test_new_blocks_share_no_samples_with_old_ones() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(3):
        reader.read(7, 8)
    reader.time += 1
    old = reader.next()
    reader.device.plan()
    reader.engine.schedule.plan(reader.device, float(reader.time))
    reader.conclude(old, (7, 8))
    for _ in range(3):
        reader.read(9, 9)
        assert [reader.mirror[tag].value for tag in (a, b)] == [9, 9]
    reader.conclude(old, (7, 8))  # again, after reads of the new block
    for _ in range(3):
        reader.read(9, 9)
        assert [reader.mirror[tag].value for tag in (a, b)] == [9, 9]


class Interrupted(Tag):
    """A tag: each look-up in a dict calls the last function of `by` first."""

    by: list[Callable[[], None]] = []  # noqa: RUF012  (emptied by each test)

    def __hash__(self) -> int:
        if self.by:
            self.by.pop()()
        return id(self)


def interrupted(again: int) -> tuple[Tag, Mirror]:
    """A tag that was 1 at 1000, and still 1 at the read `again`."""
    plain = make_tag("D0")
    tag = Interrupted(**{f.name: getattr(plain, f.name) for f in fields(plain) if f.init})
    mirror = Mirror([tag], 0)
    samples = [good(tag, 1, 1000)]
    mirror.update(samples)
    if again > 1000:
        mirror.update(Unchanged(samples, again))
    return tag, mirror


def at_look_up(number: int, do: Callable[[], None]) -> None:
    def alone() -> None:
        Interrupted.by.clear()
        do()

    Interrupted.by[:] = [alone, *[lambda: None] * (number - 1)]


@pytest.mark.parametrize("again", [1000, 1500])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_change_during_a_look_up_never_mixes_value_and_time(number: int, again: int) -> None:
    """The event loop may change the sample during a look-up by an answering thread."""
    tag, mirror = interrupted(again)

    def change() -> None:
        samples = [good(tag, 2, 2000)]
        mirror.update(samples)
        mirror.update(Unchanged(samples, 3000))

    at_look_up(number, change)
    seen = mirror[tag]
    Interrupted.by.clear()
    assert seen in [good(tag, 1, again), good(tag, 2, 2000), good(tag, 2, 3000)]


@pytest.mark.parametrize("again", [1000, 1500])
@pytest.mark.parametrize("number", range(1, 7))
def test_a_look_up_during_a_change_finds_the_old_or_the_new_sample(number: int, again: int) -> None:
    tag, mirror = interrupted(again)
    seen: list[Sample] = []
    at_look_up(number, lambda: seen.append(mirror[tag]))
    mirror.update([good(tag, 2, 2000)])
    Interrupted.by.clear()
    seen.append(mirror[tag])
    assert seen[-1] == good(tag, 2, 2000)
    assert seen[0] in [good(tag, 1, again), good(tag, 2, 2000)]


def test_a_failure_between_two_equal_reads_makes_the_value_bad() -> None:
    tag = make_tag("D0")
    reader = Reader(tag)
    for _ in range(3):
        reader.read(7)
    while reader.mirror[tag].quality is Quality.GOOD:
        reader.fail()
    assert reader.mirror[tag].quality is Quality.BAD
    reader.read(7)
    assert reader.published == [good(tag, 7, reader.time)]
