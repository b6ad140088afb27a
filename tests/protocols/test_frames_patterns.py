"""Patterns that some frame could keep the gateway busy with are refused when the file is read."""

import re
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError
from gateway.protocols.frames.patterns import check_pattern, longest_match, pattern


@pytest.mark.parametrize(
    "text",
    [
        r"(?P<state>ST|US),(?P<weight>[+-][0-9.]{8}) *(?P<unit>[a-zA-Z%]+)",
        r".*(?P<weight>[0-9.]+)kg.*",
        r"(?:[a-z]+,)*[0-9]+",
        r"\x01\x51\x00..",
        r"^\d+$",
        r"[+-]? *\d{1,3}(?:\.\d+)?",
        r"[^]]+\]",
        r"[\]a]+b",
        r"a{,3}b",
        r"a{x}",
        r"]",
        r"",
    ],
)
def test_the_patterns_of_devices_are_taken(text: str) -> None:
    check_pattern(text, 512)


@pytest.mark.parametrize(
    "text",
    [
        r"(a+)+b",
        r"(a*)*b",
        r"(a|a)*b",
        r"(?:a|ab|b)*c",
        r"(\w+\s?)*x",
        r".*.*.*x",
        r"(.*)=(.*)=(.*)",
        r"a?" * 25 + "a" * 25,
        r"(?:(?:a?)+)+",
        r"(?:.{1,40}){1,40}b",
    ],
)
def test_a_pattern_that_could_take_long_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="busy"):
        check_pattern(text, 512)


def test_a_shorter_frame_allows_more() -> None:
    check_pattern(r"(.*)=(.*)=(.*)", 64)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "no regular expression"),
        ("(?P<a>x", "no regular expression"),
        ("a**", "no regular expression"),
        ("€", "Latin-1"),
        ("[[a]", "nested set"),
        (r"(?=a)b", "groups there are"),
        (r"(?i)a", "groups there are"),
        (r"(?P<q>a)(?P=q)", "groups there are"),
        (r"(a)\1", "never before a number"),
    ],
)
def test_a_pattern_that_cannot_be_checked_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_pattern(text, 512)


@given(st.text(alphabet="ab.|()[]{}*+?^$\\,-:P<>123x0", max_size=14))
def test_any_text_is_taken_or_refused(text: str) -> None:
    with suppress(ConfigError):
        check_pattern(text, 64)
        assert pattern(text).pattern == text.encode()


parts = st.recursive(
    st.sampled_from(["a", "b", ".", "[ab]", "[^a]"]),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["*", "+", "?", "{1,3}", "{2}"])).map(
            lambda pair: f"(?:{pair[0]}){pair[1]}"
        ),
        st.tuples(inner, inner).map("".join),
        st.tuples(inner, inner).map(lambda pair: f"(?:{pair[0]}|{pair[1]})"),
    ),
    max_leaves=6,
)


@given(parts, st.text(alphabet="abc", max_size=18))
def test_a_pattern_that_is_taken_is_matched_at_once(text: str, frame: str) -> None:
    """No more than the counted ways: a refusal missing here would hang the test."""
    try:
        check_pattern(text, 512)
    except ConfigError:
        return
    long = (frame * 30).encode()[:512]
    assert pattern(text).fullmatch(long) is None or re.fullmatch(text.encode(), long)


@pytest.mark.parametrize(
    ("text", "most"),
    [
        ("F=[0-9.]{6}", 8),
        ("OK|ER(?P<code>[0-9]{2})", 4),
        (r"\x01\x51\x00..", 5),
        ("(?:ab){1,3}c?$", 7),
        (".*", 32),
        ("W[0-9]+", 32),
        ("", 0),
    ],
)
def test_the_longest_frame_that_matches_is_known_beforehand(text: str, most: int) -> None:
    assert longest_match(text, 32) == most
