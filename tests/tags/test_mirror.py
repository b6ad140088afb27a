"""The choice of samples to publish: one test for each rule in the mirror's docstring."""

from decimal import Decimal
from typing import Any

import pytest

from gateway.tags import Deadband, Publish, Quality, Reason, Sample, Tag, bad, good
from gateway.tags.mirror import Mirror
from tests.sim.plant import make_tag

SECOND = 1_000_000_000


def told(tag: Tag, *samples: Sample) -> list[Any]:
    """The values (or reasons) that are published of these samples, one after another."""
    mirror = Mirror([tag], 0)
    news = [sample for one in samples for sample in mirror.update([one])]
    return [s.value if s.quality is Quality.GOOD else s.reason for s in news]


def values(tag: Tag, *numbers: Any) -> list[Any]:
    return told(tag, *(good(tag, number, i * SECOND) for i, number in enumerate(numbers)))


def test_before_the_first_reading_a_tag_is_starting() -> None:
    tag = make_tag("D0")
    mirror = Mirror([tag], 5)
    assert mirror[tag] == bad(tag, Reason.STARTING, 5)
    assert list(mirror.samples()) == [mirror[tag]]


def test_the_first_samples_get_the_time_when_the_gateway_became_active() -> None:
    read, other = make_tag("D0"), make_tag("D1")
    mirror = Mirror([read, other], 5)
    mirror.begin(9)
    assert list(mirror.samples()) == [bad(tag, Reason.STARTING, 9) for tag in (read, other)]
    mirror.update([good(read, 1, 10)])
    mirror.begin(11)  # once only
    assert [sample.time for sample in mirror.samples()] == [10, 9]


def test_a_change_is_published_and_an_equal_value_is_not() -> None:
    assert values(make_tag("D0"), 1, 1, 2, 2, 1) == [1, 2, 1]


def test_the_current_sample_is_kept_even_if_it_is_not_published() -> None:
    tag = make_tag("D0", deadband=Deadband(10))
    mirror = Mirror([tag], 0)
    mirror.update([good(tag, 100, 1)])
    assert mirror.update([good(tag, 105, 2)]) == []
    assert mirror[tag] == good(tag, 105, 2)


def test_a_deadband_counts_from_the_last_published_value() -> None:
    assert values(make_tag("D0", deadband=Deadband(5)), 0, 3, 4, 5, 9, 10, 6, 5) == [0, 5, 10, 5]


def test_a_deadband_in_percent_is_of_the_last_published_value() -> None:
    assert values(make_tag("D0", deadband=Deadband(10, percent=True)), 100, 109, 110, 120, 121) == [
        100,
        110,
        121,
    ]


@pytest.mark.parametrize(
    ("kind", "deadband"),
    [("int16", Deadband(0.1)), ("int16", Deadband(0.3)), ("float32", Deadband(0.7))],
)
def test_steps_of_exactly_the_deadband_are_published(kind: str, deadband: Deadband) -> None:
    """The steps and the deadband are decimals: 0.3 and 0.2 differ by 0.1, their floats by less."""
    steps = [float(Decimal(repr(deadband.amount)) * step) for step in range(-100, 100)]
    assert values(make_tag("D0", type=kind, scale=0.1, deadband=deadband), *steps) == steps


def test_steps_of_less_than_the_deadband_are_not_published() -> None:
    tag = make_tag("D0", scale=0.001, deadband=Deadband(0.1))
    assert values(tag, 0.3, 0.201, 0.399, 0.2, 0.299, 0.3) == [0.3, 0.2, 0.3]


def test_steps_of_exactly_the_percentage_are_published() -> None:
    tag = make_tag("D0", scale=0.01, deadband=Deadband(10, percent=True))
    assert values(tag, 0.7, 0.63, 0.7, 0.77, 0.7) == [0.7, 0.63, 0.7, 0.77]


def test_at_zero_a_deadband_in_percent_publishes_every_change() -> None:
    assert values(make_tag("D0", deadband=Deadband(10, percent=True)), 0, 0, 1) == [0, 1]


@pytest.mark.parametrize(
    ("kind", "samples"), [("D0.1", (True, False, False)), ("M3", (True, False, False))]
)
def test_a_deadband_does_not_suppress_bits(kind: str, samples: tuple[bool, ...]) -> None:
    assert values(make_tag(kind, deadband=Deadband(5)), *samples) == [True, False]


def test_a_deadband_does_not_suppress_texts() -> None:
    tag = make_tag("D0", type="string[4]", deadband=Deadband(5))
    assert values(tag, "A", "A", "B") == ["A", "B"]


def test_a_tag_can_be_published_always() -> None:
    assert values(make_tag("D0", publish=Publish.ALWAYS), 1, 1, 1) == [1, 1, 1]


def test_a_heartbeat_publishes_an_unchanged_value() -> None:
    assert values(make_tag("D0", heartbeat=3.0), 7, 7, 7, 7, 7, 7, 7) == [7, 7, 7]


def test_a_heartbeat_goes_on_when_the_clock_was_set_back() -> None:
    tag = make_tag("D0", heartbeat=3.0)
    times = (3600, 3601, 1, 2, 3, 4, 5)  # seconds: an hour back
    mirror = Mirror([tag], 0)
    assert [second for second in times if mirror.update([good(tag, 7, second * SECOND)])] == [
        3600,
        1,
        4,
    ]


def test_a_deadband_counts_from_a_republished_value() -> None:
    tag = make_tag("D0", deadband=Deadband(5))
    mirror = Mirror([tag], 0)
    mirror.update([good(tag, 100, 1)])
    assert mirror.update([good(tag, 104, 2)]) == []
    again = [mirror[tag]]
    assert mirror.mark_published(again) == again  # which is news
    assert mirror.mark_published(again) == []
    assert mirror.update([good(tag, 96, 3)]) == [good(tag, 96, 3)]


def test_republished_equal_values_are_not_reported_as_changed() -> None:
    starting, known = make_tag("D0"), make_tag("D1", publish=Publish.ALWAYS)
    mirror = Mirror([starting, known], 0)
    mirror.update([good(known, 7, 1)])
    assert mirror.mark_published(list(mirror.samples())) == []
    assert mirror.update([good(starting, 1, 2)]) == [good(starting, 1, 2)]


def test_a_change_of_quality_or_reason_is_published_once() -> None:
    tag = make_tag("D0", deadband=Deadband(100), publish=Publish.ALWAYS)
    assert told(
        tag,
        good(tag, 1, 1),
        bad(tag, Reason.NO_REPLY, 2),
        bad(tag, Reason.NO_REPLY, 3, "still"),
        bad(tag, Reason.LINE_DOWN, 4),
        good(tag, 1, 5),
    ) == [1, Reason.NO_REPLY, Reason.LINE_DOWN, 1]


def test_a_bad_tag_keeps_the_time_when_it_became_bad() -> None:
    tag = make_tag("D0")
    mirror = Mirror([tag], 0)
    mirror.update([good(tag, 1, 1)])
    mirror.update([bad(tag, Reason.NO_REPLY, 2)])
    mirror.update([bad(tag, Reason.NO_REPLY, 9)])
    assert mirror[tag].time == 2


def test_samples_to_publish_keep_their_order() -> None:
    tags = [make_tag(f"D{n}") for n in range(5)]
    mirror = Mirror(tags, 0)
    samples = [good(tag, 1, 1) for tag in tags]
    assert mirror.update(samples) == samples
    later = [good(tag, 2 if i % 2 else 1, 2) for i, tag in enumerate(tags)]
    assert mirror.update(later) == [later[1], later[3]]
