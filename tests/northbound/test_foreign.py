"""Documents from outside have bounds, types and ranges."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.foreign import Foreign
from gateway.errors import BadValue


def of(data: bytes) -> Foreign:
    return Foreign.parse(data, 100)


def test_members_of_the_right_type_and_range_are_read() -> None:
    found = of(b'{"n": 7, "t": "abc", "none": null, "l": ["a", "b", "a"], "new": {}}')
    assert found.number("n", 0, 7) == 7
    assert found.text("t", 3) == "abc"
    assert found.text_or_none("t", 3) == "abc"
    assert found.text_or_none("none", 3) is found.text_or_none("missing", 3) is None
    assert found.texts("l", 3, 1) == {"a", "b"}


WRONG: dict[str, tuple[bytes, Callable[[Foreign], object]]] = {
    "below": (b'{"n": -1}', lambda of: of.number("n", 0, 7)),
    "above": (b'{"n": 8}', lambda of: of.number("n", 0, 7)),
    "true is no number": (b'{"n": true}', lambda of: of.number("n", 0, 7)),
    "a float is no integer": (b'{"n": 7.0}', lambda of: of.number("n", 0, 7)),
    "missing": (b"{}", lambda of: of.number("n", 0, 7)),
    "too long a text": (b'{"t": "abcd"}', lambda of: of.text("t", 3)),
    "null is no text": (b'{"t": null}', lambda of: of.text("t", 3)),
    "a number is no text": (b'{"t": 7}', lambda of: of.text_or_none("t", 3)),
    "too long a list": (b'{"l": ["", ""]}', lambda of: of.texts("l", 1, 1)),
    "a number in a list": (b'{"l": [7]}', lambda of: of.texts("l", 1, 1)),
}


@pytest.mark.parametrize(("data", "read"), WRONG.values(), ids=WRONG)
def test_another_type_or_range_is_refused(data: bytes, read: Callable[[Foreign], object]) -> None:
    document = of(data)
    with pytest.raises(BadValue):
        read(document)


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"7", b"null", b"[" * 100, b"\xff", b'{"a": NaN}', b'{"a": 1} ' * 12]
)
def test_what_is_no_object_or_too_long_is_refused(data: bytes) -> None:
    with pytest.raises(BadValue):
        of(data)


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_parsed_or_refused(data: bytes) -> None:
    try:
        document = of(data)
        document.number("n", 0, 7)
    except BadValue:
        pass
