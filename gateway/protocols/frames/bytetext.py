"""Bytes as people write them: text with control characters in angle brackets, `<STX>0151<ETX>`.

`<STX>` is a character by its ASCII name, `<02>` by its two hex digits (so `<FF>` is FFh and
form feed is `<0C>`). Everything else stands for itself. In templates `{name}` is a place that a
value fills. The characters `< > { } \\` themselves are written in hex: `<3C>`.
"""

import re
from dataclasses import dataclass
from functools import lru_cache

from gateway.errors import ConfigError

_NAMES = (
    *("NUL", "SOH", "STX", "ETX", "EOT", "ENQ", "ACK", "BEL", "BS", "HT", "LF", "VT", "0C", "CR"),
    *("SO", "SI", "DLE", "DC1", "DC2", "DC3", "DC4", "NAK", "SYN", "ETB", "CAN", "EM", "SUB"),
    *("ESC", "FS", "GS", "RS", "US"),
)
_CONTROL = {name: code for code, name in enumerate(_NAMES)} | {"SP": 0x20, "DEL": 0x7F}

_PIECE = re.compile(r"<(?P<mark>[^<>]*)>|\{(?P<hole>[^{}]*)\}|(?P<text>[^<>{}\\]+)")
_HEX = re.compile(r"[0-9A-Fa-f]{2}\Z")
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


@dataclass(frozen=True, slots=True)
class Hole:
    """A place in a template that the value of this name fills."""

    name: str


@lru_cache(maxsize=1024)
def template(text: str) -> tuple[bytes | Hole, ...]:
    """The pieces of a template. Raises `ConfigError`."""
    pieces: list[bytes | Hole] = []
    at = 0
    while at < len(text):
        match = _PIECE.match(text, at)
        if match is None:
            raise ConfigError(
                f"{text!r}: {text[at]!r} cannot stand here; control characters are written "
                f"<STX>, <CR>, and this character itself <{ord(text[at]):02X}>"
            )
        pieces.append(_piece(text, match))
        at = match.end()
    return tuple(pieces)


@lru_cache(maxsize=1024)
def octets(text: str) -> bytes:
    """The bytes that the text writes; it has no places to fill. Raises `ConfigError`."""
    found = b""
    for piece in template(text):
        if isinstance(piece, Hole):
            raise ConfigError(f"{text!r}: nothing can be filled in here, write {{ as <7B>")
        found += piece
    return found


def _piece(text: str, match: re.Match[str]) -> bytes | Hole:
    mark, hole, plain = match["mark"], match["hole"], match["text"]
    if mark is not None:
        return _character(text, mark)
    if hole is not None:
        if not NAME.match(hole):
            raise ConfigError(f"{text!r}: {{{hole}}} is no name; write the format in its field")
        return Hole(hole)
    if not plain.isascii():
        raise ConfigError(f"{text!r}: characters beyond ASCII are written in hex, <E4>")
    return plain.encode("ascii")


def _character(text: str, mark: str) -> bytes:
    if _HEX.match(mark):
        return bytes.fromhex(mark)
    if mark not in _CONTROL:
        raise ConfigError(
            f"{text!r}: <{mark}> is neither two hex digits nor the name of a control character"
        )
    return bytes([_CONTROL[mark]])
