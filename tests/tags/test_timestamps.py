"""Times as text."""

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.tags.timestamps import rfc3339


@given(st.integers(0, 4_000_000_000 * 10**9))
@settings(max_examples=50)
def test_time_is_utc_with_six_digits(time: int) -> None:
    text = rfc3339(time)
    assert len(text) == len("2026-11-20T12:00:00.123456Z")
    assert text.endswith(f".{time // 1000 % 10**6:06}Z")
