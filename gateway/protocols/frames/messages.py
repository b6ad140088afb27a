"""The frames of a device as the file names them: heard unasked, asked for, written."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from gateway.errors import ConfigError, Evidence, Garbled, Refused
from gateway.protocols.frames.bytetext import NAME, Hole, octets, template
from gateway.protocols.frames.fields import Field, check_writable
from gateway.protocols.frames.patterns import pattern
from gateway.values import Value

Values = Mapping[str, Value | Garbled]


@dataclass(frozen=True, slots=True, kw_only=True)
class Listen:
    """A frame that the device sends unasked.

    `match` is a regular expression for the whole data of the frame. `answer` is sent when all
    fields could be read; `{name}` in it repeats that field as it was heard. After `stale_after`
    seconds without such a frame its fields are no longer known. Without `fields` the frame is
    known, and means nothing.
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
        """Its fields, each a value or why there is none; None for some other frame."""
        return _values(self.match, self.fields, frame)

    def answer_to(self, frame: bytes) -> bytes | None:
        """What is answered to a frame all of whose fields could be read; None for nothing."""
        found = pattern(self.match).fullmatch(frame)
        if self.answer is None or found is None:
            return None
        return filled(self.answer, lambda name: _raw(name, self.fields[name], frame, found))


@dataclass(frozen=True, slots=True, kw_only=True)
class Ask:
    """A request, and the reply that `match` describes.

    A reply that `refused` describes is the device's "no"; its group `code` is the code.
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
            raise ConfigError("fields: say what the reply tells")

    def answers(self, frame: bytes) -> Values | None:
        """What the reply says; None for a frame that is no reply to this. Raises `Refused`."""
        values = _values(self.match, self.fields, frame)
        if values is None:
            _raise_refused(self.refused, frame)
        return values


@dataclass(frozen=True, slots=True, kw_only=True)
class Write:
    """A frame with a `{value}` in it, and the reply by which the device says that it is done.

    Without `match` nobody acknowledges: it cannot be known whether the write was done.
    """

    send: str
    value: Field
    match: str | None = None
    refused: str | None = None

    def __post_init__(self) -> None:
        if list(_holes(self.send)) != ["value"]:
            raise ConfigError(f"send {self.send!r}: the value stands in it once, as {{value}}")
        check_writable(self.value)
        _check_refused(self.refused)
        if self.match is not None:
            _check_fields(self.match, {})
        elif self.refused is not None:
            raise ConfigError("refused needs a match: how does the device say yes?")

    def frame(self, raw: bytes) -> bytes:
        """The data of the frame that writes a value whose own bytes are `raw`."""
        return filled(self.send, lambda _: raw)

    def answers(self, frame: bytes) -> bool | None:
        """True for the acknowledgement; None for a frame that is none. Raises `Refused`."""
        if self.match is not None and pattern(self.match).fullmatch(frame):
            return True
        _raise_refused(self.refused, frame)
        return None


def filled(text: str, fill: Callable[[str], bytes]) -> bytes:
    """The template with its places filled."""
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


def _value(name: str, one: Field, frame: bytes, found: re.Match[bytes]) -> Value | Garbled:
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
            raise ConfigError(f"field {name}: say its offset or columns, or name a group of match")
    for name in groups:
        if name not in fields:
            raise ConfigError(f"match has a group {name}: say in fields what it is")


def _check_refused(refused: str | None) -> None:
    if refused is not None and set(pattern(refused).groupindex) - {"code"}:
        raise ConfigError("refused has one named group at most, code")
