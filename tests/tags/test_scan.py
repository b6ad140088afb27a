"""Reads of a block: no change is missed, and every value gets the time of its read."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.engine.effects import Effect, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import (
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
from gateway.tags import Deadband, Publish, Quality, Reason, Sample, Tag, bad, good
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder, Scan
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
                self.published = list(self.mirror.update(effect.samples))

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
    assert isinstance(reader.samples, Scan)
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


class Interrupted(Tag):
    """A tag: each look-up in a dict calls the last function of `by` first."""

    by: list[Callable[[], None]] = []  # noqa: RUF012  (emptied by each test)

    def __hash__(self) -> int:
        if self.by:
            self.by.pop()()
        return id(self)


def interrupted(again: int) -> tuple[Tag, Mirror, Scan]:
    """A tag that was 1 at 1000, and still 1 at the read `again`."""
    plain = make_tag("D0")
    tag = Interrupted(**{f.name: getattr(plain, f.name) for f in fields(plain) if f.init})
    mirror = Mirror([tag], 0)
    scan = Decoder([tag], [0]).first([1], 1000)
    mirror.update(scan)
    if again > 1000:
        scan.time = again
        mirror.update(scan)
    return tag, mirror, scan


def at_look_up(number: int, do: Callable[[], None]) -> None:
    def alone() -> None:
        Interrupted.by.clear()
        do()

    Interrupted.by[:] = [alone, *[lambda: None] * (number - 1)]


@pytest.mark.parametrize("again", [1000, 1500])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_change_during_a_look_up_never_mixes_value_and_time(number: int, again: int) -> None:
    """The event loop may change the sample during a look-up by an answering thread."""
    tag, mirror, scan = interrupted(again)

    def change() -> None:
        changed = Decoder([tag], [0]).after(scan, [2], 2000)
        mirror.update(changed)
        changed.time = 3000
        mirror.update(changed)

    at_look_up(number, change)
    seen = mirror[tag]
    Interrupted.by.clear()
    assert seen in [good(tag, 1, again), good(tag, 2, 2000), good(tag, 2, 3000)]


@pytest.mark.parametrize("again", [1000, 1500])
@pytest.mark.parametrize("number", range(1, 7))
def test_a_look_up_during_a_change_finds_the_old_or_the_new_sample(number: int, again: int) -> None:
    tag, mirror, _ = interrupted(again)
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


def test_only_changed_units_are_decoded() -> None:
    decoded: list[int] = []

    def convert(unit: int) -> int:
        decoded.append(unit)
        return unit

    tags = [make_tag(f"D{n}", type="bcd16") for n in range(4)]
    for tag in tags:
        object.__setattr__(tag, "convert", convert)
    decoder = Decoder(tags, range(4))
    scan = decoder.first([1, 2, 3, 4], 1)
    decoded.clear()
    later = decoder.after(scan, [1, 2, 9, 4], 2)
    assert decoded == [9]
    assert list(later) == [good(tag, n, 2) for tag, n in zip(tags, (1, 2, 9, 4), strict=True)]
    assert list(scan) == [good(tag, n, 1) for tag, n in zip(tags, (1, 2, 3, 4), strict=True)]


def test_a_change_of_one_unit_reaches_every_tag_over_it() -> None:
    names = ("D0.3", "D0.4", "D1")
    tags = [make_tag("D0", name="word"), make_tag("D0", name="both", type="int32")]
    tags += [make_tag(name) for name in names]
    decoder = Decoder(tags, (0, 0, 0, 0, 1))
    scan = decoder.first([0, 5], 1)
    assert [sample.value for sample in scan] == [0, 5 << 16, False, False, 5]
    scan = decoder.after(scan, [8, 5], 2)
    assert [sample.value for sample in scan] == [8, (5 << 16) + 8, True, False, 5]


def test_samples_to_publish_keep_their_time() -> None:
    tags = [make_tag(text) for text in TWO]
    decoder, mirror = Decoder(tags, (0, 1)), Mirror(tags, 0)
    mirror.update(first := decoder.first([1, 2], 1))
    second = decoder.after(first, [1, 3], 2)
    to_publish = mirror.update(second)
    second.time = 3  # the next read is equal
    assert list(to_publish) == [good(tags[1], 3, 2)]
    assert mirror[tags[1]] == good(tags[1], 3, 3)


def test_a_deadband_counts_from_the_last_published_value_of_a_scan() -> None:
    tags = [make_tag("D0", deadband=Deadband(5)), make_tag("D1")]
    reader = Reader(*tags)
    published = []
    for value in (0, 3, 4, 5, 9, 10, 6, 5):
        reader.read(value, 7)
        published += [sample.value for sample in reader.published if sample.tag is tags[0]]
        assert reader.mirror[tags[0]] == good(tags[0], value, reader.time)
    assert published == [0, 5, 10, 5]


NAN = (0, 0x7FC0)


@pytest.mark.parametrize("between", ["bad", "resync", "plan"])
def test_the_first_read_after_a_break_is_compared_with_nothing(between: str) -> None:
    tag = make_tag("D0", type="float32")
    reader = Reader(tag)
    for _ in range(3):
        reader.read(*NAN)
    before, schedule = reader.samples, reader.engine.schedule
    assert list(before) == [bad(tag, Reason.NOT_A_NUMBER, 1)]
    match between:
        case "bad":
            schedule.polls(reader.device)[0].forget(float(reader.time))
        case "resync":
            reader.device.health.left_outstanding(tag.span, float(reader.time))
        case _:
            reader.device.plan()
            schedule.plan(reader.device, float(reader.time))
    reader.read(*NAN)
    assert isinstance(before, Scan)
    assert isinstance(reader.samples, Scan)
    assert reader.samples.latest is not before.latest
    assert reader.mirror[tag] == bad(tag, Reason.NOT_A_NUMBER, 1)


WORDS = st.sampled_from([0, 1, 2, 0x7FC0, 0x3F80, 0xFFFF])
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("read"), st.lists(WORDS, min_size=6, max_size=6)),
        st.tuples(st.just("one"), st.tuples(st.integers(0, 5), WORDS)),
        st.tuples(st.just("equal"), st.none()),
        st.tuples(st.just("bad"), st.integers(0, 9)),
        st.tuples(st.just("other"), st.integers(0, 9)),
        st.tuples(st.just("again"), st.integers(0, 9)),
        st.tuples(st.just("resync"), st.none()),
    ),
    max_size=25,
)


@settings(deadline=None, max_examples=80)
@given(STEPS)
def test_scans_and_single_samples_give_the_same_mirror(steps: list[tuple[str, Any]]) -> None:
    """The other mirror gets a new sample of each tag at each read."""
    rules: list[dict[str, Any]] = [
        {"type": "float32"},
        {"type": "uint16", "deadband": Deadband(2)},
        {"type": "bcd16", "publish": Publish.ALWAYS},
        {"type": "int16", "heartbeat": 2e-9},
        {"type": "int16", "scale": 0.1, "deadband": Deadband(10, percent=True)},
        {"type": "float32", "heartbeat": 3e-9, "deadband": Deadband(1)},
        {"type": "string[4]"},
    ]
    tags = [make_tag(f"D{n % 5}", name=f"t{n}", **rule) for n, rule in enumerate(rules)]
    tags += [make_tag(f"D0.{bit}") for bit in (0, 1)] + [make_tag("D5")]
    reader, other = Reader(*tags), Mirror(tags, 0)
    words = [0] * 6
    for step, what in steps:
        if step in ("bad", "other", "again"):
            tag = tags[what]
            if step == "again":
                assert reader.mirror.mark_published([reader.mirror[tag]]) == other.mark_published(
                    [other[tag]]
                )
                continue
            sample = bad(tag, Reason.NO_REPLY, reader.time)
            if step == "other":
                sample = good(tag, "x" if tag is tags[6] else 3, reader.time)
            assert list(reader.mirror.update([sample])) == other.update([sample])
            continue
        if step == "resync":
            reader.device.health.left_outstanding(tags[0].span, float(reader.time))
        elif step == "read":
            words = what
        elif step == "one":
            words = [*words]
            words[what[0]] = what[1]
        reader.read(*words)
        fresh = [
            bad(tag, Reason.NOT_A_NUMBER, reader.time)
            if (value := tag.decode(words[tag.span.start : tag.span.start + tag.span.size])) is None
            else good(tag, value, reader.time)
            for tag in reader.engine.schedule.polls(reader.device)[0].block.tags
        ]
        assert reader.published == other.update(fresh)
        assert list(reader.mirror.samples()) == list(other.samples())
