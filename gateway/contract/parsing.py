"""Payloads of writes -> values: JSON, checked before its values reach a tag."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Never, TypeVar

from gateway.errors import BadValue
from gateway.values import LONGEST_ARRAY, Value
from gateway.values.numerals import Scalar, parse_decimal

T = TypeVar("T")
LONGEST_WRITE = 64 * 1024  # bytes; a tag holds 250 characters or 2000 elements at most
LARGEST_GROUP = 256  # tags
# Most clients name no encoding: Zenoh's default is `zenoh/bytes`.
_TEXTS = frozenset(
    {"", "zenoh/bytes", "zenoh/string", "text/plain", "text/json", "application/json"}
)


def check_encoding(name: str) -> None:
    """Raises `BadValue` for an encoding that is not JSON: CBOR's -22 is the byte of JSON's 5.

    `name`: as Zenoh prints it, with a schema or without.
    """
    if name.partition(";")[0].strip().lower() not in _TEXTS:
        raise BadValue(f"the encoding {name[:60]!r} is not supported: send application/json")


def parse_write(payload: bytes) -> Value:
    """Returns the value of a write: a JSON value, or `{"value": ...}`. Raises `BadValue`."""
    return _value(_loaded(payload, _only_value))


def parse_group(payload: bytes) -> list[tuple[str, Value | BadValue]]:
    """Returns the tags and values of a write to a device: `{"recipe/a": 1, "recipe/b": 2}`.

    In their order, also a tag that is named twice. Raises `BadValue` for another payload.
    """
    found = _loaded(payload, _Pairs)
    if not isinstance(found, _Pairs) or not found:
        raise BadValue('send the tags and values as one object: {"recipe/a": 1, "recipe/b": 2}')
    if len(found) > LARGEST_GROUP:
        raise BadValue(f"{len(found)} tags are written at once, more than {LARGEST_GROUP}")
    return [(_text(name), parsed(_member, value)) for name, value in found]


def parsed(parse: Callable[[T], Value], data: T) -> Value | BadValue:
    """Returns the value, or why there is none."""
    try:
        return parse(data)
    except BadValue as error:
        return error


class _Pairs(list[tuple[str, object]]):
    """The members of an object."""


def _member(found: object) -> Value:
    return _value(_only_value(found) if isinstance(found, _Pairs) else found)


def _loaded(payload: bytes, of_object: Callable[[list[tuple[str, object]]], object]) -> object:
    """Returns the decoded JSON. Raises `BadValue`."""
    if not payload.strip():
        raise BadValue("the payload is empty: send a JSON value such as 12.5")
    if len(payload) > LONGEST_WRITE:
        raise BadValue(f"the payload has {len(payload)} bytes, more than {LONGEST_WRITE}")
    try:
        # Not orjson: it turns integers beyond 64 bits into floats, which then may fit.
        found: object = json.loads(
            payload.decode(),
            parse_constant=_no_number,
            parse_float=_finite,
            object_pairs_hook=of_object,
        )
    except UnicodeDecodeError:
        raise BadValue("the payload is no UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise BadValue(f"the payload is no JSON: {error}") from None
    except RecursionError:
        raise BadValue("the payload is nested too deeply") from None
    except BadValue:
        raise
    except ValueError:  # an integer of more than 4300 digits
        raise BadValue("the number in the payload is too long") from None
    return found


def _value(found: object) -> Value:
    value = found.value if isinstance(found, _Wrapped) else found
    return _elements(value) if isinstance(value, list) else _scalar(value)


@dataclass(frozen=True, slots=True)
class _Wrapped:
    value: object


def _only_value(pairs: list[tuple[str, object]]) -> _Wrapped:
    if [key for key, _ in pairs] != ["value"]:
        raise BadValue('an object must hold "value" once, and nothing else')
    return _Wrapped(pairs[0][1])


def _no_number(text: str) -> Never:
    raise BadValue(f"{text} is no number in JSON")


def _finite(text: str) -> int | float:
    number = parse_decimal(text)
    if not math.isfinite(number):
        raise BadValue("the number in the payload is too large")
    if not number and text.lower().partition("e")[0].strip("-.0"):
        raise BadValue("the number in the payload is too small: a float makes it 0")
    return number


def _elements(found: list[object]) -> Value:
    if len(found) > LONGEST_ARRAY:
        raise BadValue(f"the list has {len(found)} values, more than {LONGEST_ARRAY}")
    try:
        return tuple(map(_scalar, found))
    except BadValue as error:
        raise BadValue(f"in the list: {error}") from None


def _scalar(found: object) -> Scalar:
    match found:
        case bool() | int() | float():
            return found
        case str():
            return _text(found)
        case _:
            raise BadValue('send a JSON value: true, 12.5, "AB", {"value": 12.5}, or a list')


def _text(found: str) -> str:
    if any("\ud800" <= character <= "\udfff" for character in found):
        raise BadValue("the text holds half a surrogate pair")
    return found
