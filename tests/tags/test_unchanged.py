"""What is read again as it was: its time goes on, nothing else does, and no change is missed."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import pytest

from gateway.engine.device import Device
from gateway.engine.jobs import Poll
from gateway.engine.schedule import Schedule
from gateway.errors import NoReply
from gateway.tags import Publish, Quality, Reason, Sample, Tag, bad, good
from gateway.tags.mirror import Mirror
from gateway.tags.unchanged import Unchanged
from tests.sim.bench import WIRE
from tests.sim.plant import device, make_tag
from tests.sim.virtual import on_virtual_time


class Reader:
    """A device that is read by hand into a mirror, a second between two readings."""

    def __init__(self, *tags: Tag) -> None:
        self.device: Device = device(list(tags))
        self.mirror = Mirror(tags, 0)
        self.time = 0
        self.news: list[Sample] = []
        self.passed: Sequence[Sample] = ()
        self.schedule = Schedule([self.device], 0.0)
        self.then = Consequences("line", self.schedule, self, lambda: self.time)
        self.device.health.answered()
        self.schedule.plan(self.device, 0.0)
        self.device.turnaround = WIRE.character  # set: not planned anew

    def samples(self, samples: Sequence[Sample]) -> None:
        self.passed = samples
        self.news = self.mirror.update(samples)

    def online(self, device: Device, online: bool) -> None:
        raise AssertionError("nobody asked for it")

    @property
    def poll(self) -> Poll:
        (poll,) = self.schedule.polls(self.device)
        return poll

    def read(self, *units: int) -> None:
        self.time += 1
        self.then.read(self.poll, units, float(self.time))


TWO = ("D0", "D1")


def test_the_third_equal_read_only_moves_the_time() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(3):
        reader.read(7, 8)
    assert isinstance(reader.passed, Unchanged)
    assert reader.news == []
    assert [reader.mirror[a], reader.mirror[b]] == [good(a, 7, 3), good(b, 8, 3)]
    assert list(reader.mirror.samples()) == [good(a, 7, 3), good(b, 8, 3)]
    assert list(reader.passed) == [good(a, 7, 3), good(b, 8, 3)]
    assert reader.passed[1:] == [good(b, 8, 3)]


def test_a_change_after_any_number_of_equal_reads_is_published() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for count in range(5):
        for _ in range(count):
            reader.read(7, 8)
        reader.read(7, count)
        assert reader.mirror[b] == good(b, count, reader.time)
        assert reader.news[-1] == good(b, count, reader.time)
        assert reader.mirror[a] == good(a, 7, reader.time)


@pytest.mark.parametrize("before", [1, 2, 3])
def test_a_bad_value_becomes_good_again_with_equal_words(
    before: int,
) -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(before):
        reader.read(7, 8)
    reader.then.bad([b], Reason.NO_REPLY, "gone")
    assert reader.mirror[b].quality is Quality.BAD
    assert reader.mirror[a] == good(a, 7, before)
    for _ in range(3):
        reader.read(7, 8)
        assert reader.mirror[b] == good(b, 8, reader.time)
        assert reader.mirror[a] == good(a, 7, reader.time)


def test_another_value_in_between_is_replaced() -> None:
    """A block read late, when another that holds its tags was asked for already."""
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for before in (1, 2, 3):
        for _ in range(before):
            reader.read(7, 8)
        reader.samples([good(a, 666, reader.time)])
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
    told = []
    for _ in range(9):
        reader.read(7, 8)
        told += [sample.time for sample in reader.news if sample.tag is eager]
    assert told == (list(range(1, 10)) if "publish" in settings else [1, 3, 5, 7, 9])


def test_new_blocks_share_no_samples_with_old_ones() -> None:
    a, b = tags = [make_tag(text) for text in TWO]
    reader = Reader(*tags)
    for _ in range(3):
        reader.read(7, 8)
    old = reader.poll
    reader.device.plan()
    reader.schedule.plan(reader.device, 3.0)
    assert reader.poll is not old
    for _ in range(3):
        reader.read(9, 9)
    reader.then.read(old, (7, 8), 6.0)  # it had been asked before
    for _ in range(3):
        reader.read(9, 9)
        assert [reader.mirror[tag].value for tag in (a, b)] == [9, 9]


class Interrupted(Tag):
    """A tag; whoever looks it up in a dict is interrupted by the last of `by`."""

    by: list[Callable[[], None]] = []  # noqa: RUF012  (emptied by each test)

    def __hash__(self) -> int:
        if self.by:
            self.by.pop()()
        return id(self)


def interrupted(again: int) -> tuple[Tag, Mirror]:
    """A tag that was 1 at 1000, and still when it was read `again`."""
    plain = make_tag("D0")
    tag = Interrupted(**{f.name: getattr(plain, f.name) for f in fields(plain) if f.init})
    mirror = Mirror([tag], 0)
    told = [good(tag, 1, 1000)]
    mirror.update(told)
    if again > 1000:
        mirror.update(Unchanged(told, again))
    return tag, mirror


def at_look_up(number: int, do: Callable[[], None]) -> None:
    def alone() -> None:
        Interrupted.by.clear()
        do()

    Interrupted.by[:] = [alone, *[lambda: None] * (number - 1)]


@pytest.mark.parametrize("again", [1000, 1500])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_change_during_a_look_up_never_mixes_value_and_time(number: int, again: int) -> None:
    """As an answering thread is by the event loop, wherever it likes."""
    tag, mirror = interrupted(again)

    def change() -> None:
        told = [good(tag, 2, 2000)]
        mirror.update(told)
        mirror.update(Unchanged(told, 3000))

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


@on_virtual_time
async def test_a_failure_between_two_equal_reads_makes_the_value_bad() -> None:
    tag = make_tag("D0")
    reader = Reader(tag)
    for _ in range(3):
        reader.read(7)
    reader.poll.tries = 99
    reader.then.unread(reader.poll, NoReply("no reply"))
    assert reader.mirror[tag].quality is Quality.BAD
    reader.read(7)
    assert reader.news == [good(tag, 7, 4)]
