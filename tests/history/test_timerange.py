"""Zenoh's time ranges."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange, time_range
from gateway.errors import BadValue
from tests.history.recorded import NOON, SECOND


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("[..]", EARLIEST, LATEST),
        ("]..[", EARLIEST, LATEST),
        ("[now(-1h)..]", NOON - 3600 * SECOND, LATEST),
        ("[now(-1.5h)..now()]", NOON - 5400 * SECOND, NOON),
        ("[now(-1h30min)..]", NOON - 5400 * SECOND, LATEST),
        ("90m", NOON - 5400 * SECOND, LATEST),
        ("[2026-11-21..2026-11-21T12:00]", NOON - 43_200 * SECOND, NOON),
        ("[..now(-500ms)]", EARLIEST, NOON - SECOND // 2),
        ("[now(-2)..now(+7u)]", NOON - 2 * SECOND, NOON + 7000),
        ("[now(-1w)..now(1d)]", NOON - 7 * 86400 * SECOND, NOON + 86400 * SECOND),
        ("[2026-11-21T12:00:00Z..]", NOON, LATEST),
        ("]2026-11-21T12:00:00Z..", None, None),
        ("]2026-11-21T12:00:00Z..2026-11-21T12:00:01.5Z[", NOON + 1, NOON + 3 * SECOND // 2 - 1),
        ("[2026-11-21 12:00:00.000000001..2026-11-21T14:00:02+02:00]", NOON + 1, NOON + 2 * SECOND),
        ("[1969-12-31T23:59:59.25Z..1970-01-01T00:00:00Z]", -3 * SECOND // 4, 0),
        ("[0001-01-01T00:00:00Z..9999-12-31T23:59:59Z]", EARLIEST, LATEST),
        ("[now(-999999999999999999w)..]", EARLIEST, LATEST),
    ],
)
def test_a_range_is_parsed_as_zenoh_writes_it(text: str, first: int | None, last: int) -> None:
    if first is None:
        with pytest.raises(BadValue):
            time_range(text, NOON)
    else:
        assert time_range(text, NOON) == TimeRange(first, last)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "..",
        "[now(-1h)",  # what Zenoh leaves of `[now(-1h);30m]`
        "[now(-1h);30m]",
        "[now..]",
        "[now(-)..]",
        "[now(-1y)..]",
        "[now(--1h)..]",
        "[yesterday..]",
        "[2026-11..]",
        "0s",
        "1h..",
        "[2026-02-30T12:00:00Z..]",
        "[2026-11-21T12:00:61Z..]",
        "[2026-11-21T12:00:00.1234567890Z..]",
        "[..now()..]",
        "(now()..)",
    ],
)
def test_a_text_that_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(BadValue):
        time_range(text, NOON)


@given(st.text("[].now()-+0123456789smhdTZ: \x00é", max_size=40))
def test_any_text_is_a_range_or_refused(text: str) -> None:
    try:
        first, last = time_range(f"[{text}", NOON)
    except BadValue:
        return
    assert EARLIEST <= first <= LATEST
    assert EARLIEST <= last <= LATEST
