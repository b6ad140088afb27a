"""The frames of a device in the file: unsolicited frames, requests with replies, writes."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from gateway.errors import ConfigError, Evidence, Garbled, Refused
from gateway.protocols.frames.bytetext import NAME, Hole, octets, template
from gateway.protocols.frames.fields import Field, check_writable
from gateway.protocols.frames.patterns import pattern
from gateway.values.numerals import Scalar

Values = Mapping[str, Scalar | Garbled]


@dataclass(frozen=True, slots=True, kw_only=True)
class Listen:
    """An unsolicited frame of the device.

    `match` is a regular expression for the whole data of the frame. `answer` is sent when all
    fields are good; `{name}` in it repeats the bytes of that field. After `stale_after` seconds
    without the frame its fields become bad. A frame without `fields` is ignored.
    """

    match: str = ".*"
    fields: Mapping[str, Field] = field(default_factory=dict)
    answer: str | None = None
    stale_after: float | None = None

    def __post_init__(self) -> None:
        _check_fields(self.match, self.fields)
        if self.stale_after is not None and self.stale_after <= 0:
            raise ConfigError("stale_after is longer than zero")
        for name in _holes(self.answer or ""):
            if name not in self.fields:
                raise ConfigError(
                    f"answer: {{{name}}} is none of its fields: {listed(self.fields)}"
                )

    def values(self, frame: bytes) -> Values | None:
        """Returns its fields, each a value or the damage that hides it; None for another frame."""
        return _values(self.match, self.fields, frame)

    def answer_to(self, frame: bytes) -> bytes | None:
        """Returns the reply to a frame with good fields; None: no reply."""
        found = pattern(self.match).fullmatch(frame)
        if self.answer is None or found is None:
            return None
        return filled(self.answer, lambda name: _raw(name, self.fields[name], frame, found))


@dataclass(frozen=True, slots=True, kw_only=True)
class Ask:
    """A request, and its reply, which `match` describes.

    `refused` describes an error reply; its group `code` is the error code.
    """

    send: str
    match: str = ".*"
    fields: Mapping[str, Field] = field(default_factory=dict)
    refused: str | None = None

    def __post_init__(self) -> None:
        octets(self.send)
        _check_fields(self.match, self.fields)
        _check_refused(self.refused)
        if not self.fields:
            raise ConfigError("fields: name at least one field of the reply")

    def answers(self, frame: bytes) -> Values | None:
        """Returns the fields of the reply; None for a frame that is not it. Raises `Refused`."""
        values = _values(self.match, self.fields, frame)
        if values is None:
            _raise_refused(self.refused, frame)
        return values


@dataclass(frozen=True, slots=True, kw_only=True)
class Write:
    """A frame with a `{value}` in it, and the acknowledgement of the device.

    Without `match` there is no acknowledgement, and the result of a write stays unknown.
    """

    send: str
    value: Field
    match: str | None = None
    refused: str | None = None

    def __post_init__(self) -> None:
        if list(_holes(self.send)) != ["value"]:
            raise ConfigError(f"send {self.send!r}: it needs {{value}} exactly once")
        check_writable(self.value)
        _check_refused(self.refused)
        if self.match is not None:
            _check_fields(self.match, {})
        elif self.refused is not None:
            raise ConfigError("refused needs a match for the acknowledgement")

    def frame(self, raw: bytes) -> bytes:
        """Returns the data of the frame that writes a value with the bytes `raw`."""
        return filled(self.send, lambda _: raw)

    def answers(self, frame: bytes) -> bool | None:
        """Returns True for the acknowledgement; None for another frame. Raises `Refused`."""
        if self.match is not None and pattern(self.match).fullmatch(frame):
            return True
        _raise_refused(self.refused, frame)
        return None


def filled(text: str, fill: Callable[[str], bytes]) -> bytes:
    """Returns the template with its places filled."""
    pieces = template(text)
    return b"".join(fill(piece.name) if isinstance(piece, Hole) else piece for piece in pieces)


def listed(names: Iterable[str]) -> str:
    """Names for a message."""
    return ", ".join(names) or "(none)"


def _holes(text: str) -> Iterator[str]:
    return (piece.name for piece in template(text) if isinstance(piece, Hole))


def _values(match: str, fields: Mapping[str, Field], frame: bytes) -> Values | None:
    found = pattern(match).fullmatch(frame)
    if found is None:
        return None
    return {name: _value(name, one, frame, found) for name, one in fields.items()}


def _value(name: str, one: Field, frame: bytes, found: re.Match[bytes]) -> Scalar | Garbled:
    try:
        return one.take(_raw(name, one, frame, found))
    except Garbled as error:
        return Garbled(f"{name}: {error}", frame, evidence=error.evidence)


def _raw(name: str, one: Field, frame: bytes, found: re.Match[bytes]) -> bytes:
    if one.placed:
        return one.cut(frame)
    raw: bytes | None = found[name]
    if raw is None:
        raise Garbled("not in this frame", frame, evidence=Evidence.SHAPE)
    return raw


def _raise_refused(refused: str | None, frame: bytes) -> None:
    found = pattern(refused).fullmatch(frame) if refused is not None else None
    if found is None:
        return
    raw: bytes = found.groupdict().get("code") or b""
    code = raw.decode("ascii") if raw.isascii() and raw.isalnum() else raw.hex().upper()
    raise Refused(f"the device refused{', code ' + code if code else ''}", code=code)


def _check_fields(match: str, fields: Mapping[str, Field]) -> None:
    groups = pattern(match).groupindex
    for name, one in fields.items():
        if not NAME.match(name):
            raise ConfigError(f"field {name!r}: letters, digits and _, not beginning with a digit")
        if one.placed and name in groups:
            raise ConfigError(f"field {name} has a place of its own and is a group of match too")
        if not one.placed and name not in groups:
            raise ConfigError(f"field {name}: give its offset or columns, or name a group of match")
    for name in groups:
        if name not in fields:
            raise ConfigError(f"match has a group {name}: add a field with this name")


def _check_refused(refused: str | None) -> None:
    if refused is not None and set(pattern(refused).groupindex) - {"code"}:
        raise ConfigError("refused has one named group at most, code")
