"""A field of a frame: decoding of received values, encoding of values to send."""

import math
import re
import struct
from dataclasses import dataclass
from typing import Literal

from gateway.errors import BadValue, ConfigError, Evidence, Garbled
from gateway.values import LONGEST_STRING, STRUCT, Kind, ValueType
from gateway.values.numerals import Scalar, real, shortest, whole

FieldType = Literal[
    "uint8",
    "int8",
    "uint16",
    "int16",
    "uint32",
    "int32",
    "uint64",
    "int64",
    "float32",
    "float64",
    "bcd8",
    "bcd16",
    "bcd32",
    "text",
    "integer",
    "decimal",
]

_BCD = {"bcd8": 1, "bcd16": 2, "bcd32": 4}
_FLOATS = ("float32", "float64")
_WIDER = {
    "uint8": Kind.UINT16,
    "int8": Kind.INT16,
    "bcd8": Kind.BCD16,
    "integer": Kind.INT64,
    "decimal": Kind.FLOAT64,
}

_COLUMNS = re.compile(r"([1-9][0-9]{0,2})-([1-9][0-9]{0,2})\Z")
_FORMAT = re.compile(r"[+ ]?0?(?P<width>[1-9][0-9]?)?(?:\.[0-9]{1,2}f|d)\Z")
_NUMBER = re.compile(rb"(?P<sign>[+-]?) *(?P<number>[0-9]{1,18}(?:\.[0-9]{0,18})?|\.[0-9]{1,18})\Z")
_LONGEST_NUMBER = 24  # characters, without `format`
_HEX = re.compile(rb"(?:[0-9A-Fa-f]{2})+\Z")


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One value of a frame.

    Its place: `offset` (bytes, the first is 0), `columns` (characters, the first is 1: `7-14`),
    or, with neither, the group of its name in `match`. Its type: `uint8` to `float64` and BCD as
    raw bytes, with `hex` as two hex characters each; `text`, `integer`, `decimal` as characters.
    `bit` picks one bit of an unsigned number, `byte` one half of a `uint16`. `format` is the
    format of a number to write, as in Python: `06.2f`, `+8.1f`, `04d`.
    """

    type: FieldType
    offset: int | None = None
    columns: str | None = None
    byte_order: Literal["low_first", "high_first"] | None = None
    hex: bool = False
    bit: int | None = None
    byte: Literal["low", "high"] | None = None
    decimal_point: Literal[".", ","] = "."
    encoding: Literal["ascii", "latin-1", "utf-8"] = "ascii"
    format: str | None = None

    def __post_init__(self) -> None:
        self._check_place()
        self._check_number()
        self._check_text()

    def _check_place(self) -> None:
        if self.offset is not None and self.columns is not None:
            raise ConfigError("offset or columns: a field has one place")
        if self.offset is not None and (self.size is None or self.offset < 0):
            raise ConfigError(f"offset is 0 or more, and of characters write columns ({self.type})")
        if self.columns is not None:
            match = _COLUMNS.match(self.columns)
            if match is None or int(match[1]) > int(match[2]):
                raise ConfigError(f"columns {self.columns!r}: write first and last, such as 7-14")
            width = int(match[2]) - int(match[1]) + 1
            if self.size is not None and self.size != width:
                raise ConfigError(f"columns {self.columns}: {self.type} takes {self.size}")

    def _check_number(self) -> None:
        if self.size is None:
            for name in ("byte_order", "bit", "byte"):
                if getattr(self, name) is not None:
                    raise ConfigError(f"{self.type} has no {name}")
            if self.hex:
                raise ConfigError(
                    f"hex is a notation of bytes: use it with uint16, not {self.type}"
                )
            return
        if self._octets > 1 and self.byte_order is None:
            raise ConfigError(f"{self.type} needs a byte_order: low_first or high_first")
        if self.bit is not None and not (
            self.type.startswith("uint") and 0 <= self.bit < 8 * self._octets
        ):
            raise ConfigError(
                f"{self.type} has no bit {self.bit}: use an unsigned type and its bits"
            )
        if self.byte is not None and (self.type != "uint16" or self.bit is not None):
            raise ConfigError("byte is the low or high half of a uint16, without bit")

    def _check_text(self) -> None:
        if self.decimal_point != "." and self.type != "decimal":
            raise ConfigError(f"decimal_point belongs to decimal, not {self.type}")
        if self.encoding != "ascii" and self.type != "text":
            raise ConfigError(f"encoding belongs to text, not {self.type}")
        if self.format is None:
            return
        kind = {"integer": "d", "decimal": "f"}.get(self.type)
        if kind is None:
            raise ConfigError(f"format belongs to integer and decimal, not {self.type}")
        if not _FORMAT.match(self.format) or self.format[-1] != kind:
            example = "04d" if kind == "d" else "06.2f"
            raise ConfigError(f"format {self.format!r} of {self.type}: write it like {example}")

    @property
    def placed(self) -> bool:
        """True when it has a place of its own, not a group of `match`."""
        return self.offset is not None or self.columns is not None

    @property
    def kind(self) -> Literal["bool", "integer", "number", "text"]:
        """The kind of its values."""
        if self.bit is not None:
            return "bool"
        if self.type in ("decimal", *_FLOATS):
            return "number"
        return "text" if self.type == "text" else "integer"

    @property
    def value_type(self) -> ValueType:
        """The type of its values, or the next wider one that tags have."""
        if self.bit is not None:
            return ValueType(Kind.BOOL)
        if self.type == "text":
            first, _, last = (self.columns or "").partition("-")
            return ValueType(Kind.STRING, int(last) - int(first) + 1 if last else LONGEST_STRING)
        return ValueType(_WIDER.get(self.type) or Kind(self.type))

    @property
    def _octets(self) -> int:
        return _BCD.get(self.type) or struct.calcsize(STRUCT[self.type])

    @property
    def size(self) -> int | None:
        """Its characters in the frame; None where the number varies."""
        if self.type in _BCD or self.type in STRUCT:
            return self._octets * (2 if self.hex else 1)
        return None

    @property
    def widest(self) -> int | None:
        """The most characters of a written value; None for a text."""
        if self.size is not None or self.type == "text":
            return self.size
        match = _FORMAT.match(self.format or "")
        return int(match["width"]) if match and match["width"] else _LONGEST_NUMBER

    def cut(self, frame: bytes) -> bytes:
        """Returns its bytes, by offset or columns. Raises `Garbled` if some are missing."""
        if self.columns is not None:
            first, last = (int(column) for column in self.columns.split("-"))
            start, end = first - 1, last
        else:
            start = self.offset or 0
            end = start + (self.size or 0)
        if len(frame) < end:
            raise _garbled(f"the frame has {len(frame)} bytes, not {end}", frame)
        return frame[start:end]

    def take(self, raw: bytes) -> Scalar:
        """Returns the value of the bytes. Raises `Garbled`."""
        match self.type:
            case "text":
                return self._text(raw)
            case "integer" | "decimal":
                return self._written_number(raw)
            case _:
                return self._raw_number(raw)

    def _text(self, raw: bytes) -> str:
        try:
            text = raw.decode(self.encoding)
        except UnicodeDecodeError:
            raise _garbled(f"no {self.encoding} text", raw) from None
        return text.rstrip(" ") if self.columns is not None else text

    def _written_number(self, raw: bytes) -> Scalar:
        point = self.decimal_point.encode()
        plain = raw.strip(b" ")
        if point == b"," and b"." in plain:
            raise _garbled("no number with a decimal comma", raw)
        match = _NUMBER.match(plain.replace(point, b"."))
        if match is None or (self.type == "integer" and b"." in match["number"]):
            raise _garbled(f"no {self.type} number", raw)
        text = (match["sign"] + match["number"]).decode()
        return int(text) if self.type == "integer" else float(text)

    def _raw_number(self, raw: bytes) -> Scalar:
        if len(raw) != self.size:
            raise _garbled(f"{self.type} takes {self.size} bytes", raw)
        if self.hex:
            if not _HEX.match(raw):
                raise _garbled("no hex digits", raw)
            raw = bytes.fromhex(raw.decode("ascii"))
        ordered = raw[::-1] if self.byte_order == "low_first" else raw
        if self.type in _BCD:
            if not ordered.hex().isdecimal():
                raise _garbled("a BCD digit above 9", raw)
            return int(ordered.hex())
        number: int | float | None = struct.unpack(STRUCT[self.type], ordered)[0]
        if self.type == "float32" and number is not None:
            number = shortest(number)
        if number is None or not math.isfinite(number):
            raise _garbled("not a number", raw)
        if self.byte is not None:
            return int(number) >> 8 if self.byte == "high" else int(number) & 0xFF
        return number if self.bit is None else bool(int(number) >> self.bit & 1)

    def put(self, value: Scalar) -> bytes:
        """Returns the bytes of a value. Raises `BadValue`."""
        if self.bit is not None or self.byte is not None:
            raise BadValue("a part of a number cannot be written")
        if self.type == "text":
            return self._put_text(value)
        number = real(value) if self.kind == "number" else whole(value)
        return self._put_written(number) if self.size is None else self._put_raw(number)

    def _put_text(self, value: Scalar) -> bytes:
        if not isinstance(value, str):
            raise BadValue(f"{value!r} is no text")
        if not value.isprintable():
            # A CR inside a text would end the frame there, and its rest be the next command.
            raise BadValue(f"{value!r} holds control characters")
        try:
            return value.encode(self.encoding)
        except UnicodeEncodeError:
            raise BadValue(f"{value!r} has characters that are not in {self.encoding}") from None

    def _put_written(self, value: float) -> bytes:
        layout = self.format or ("d" if self.type == "integer" else ".6f")
        if layout.endswith("f"):
            value = round(value, int(layout[:-1].partition(".")[2])) + 0.0  # no "-0.00"
        text = format(value, layout)
        match = _FORMAT.match(layout)
        width = int(match["width"]) if match and match["width"] else len(text)
        if len(text) > width:
            raise BadValue(f"{value} does not fit {width} characters")
        return text.replace(".", self.decimal_point).encode("ascii")

    def _put_raw(self, value: float) -> bytes:
        try:
            if self.type in _BCD:
                raw = bytes.fromhex(f"{value:0{2 * self._octets}d}") if value >= 0 else b""
            else:
                raw = struct.pack(STRUCT[self.type], value)
        except (struct.error, OverflowError, ValueError):
            raw = b""
        if len(raw) != self._octets:
            raise BadValue(f"{value} does not fit {self.type}")
        ordered = raw[::-1] if self.byte_order == "low_first" else raw
        return ordered.hex().upper().encode("ascii") if self.hex else ordered


def check_writable(field: Field) -> None:
    """Checks a field for `{value}`: its format must be complete. Raises `ConfigError`."""
    if field.placed:
        raise ConfigError(
            "the place of a value that is sent is {value} in send: no offset, columns"
        )
    if field.bit is not None or field.byte is not None:
        raise ConfigError("a part of a number cannot be written: leave out bit and byte")
    if field.type == "decimal" and field.format is None:
        raise ConfigError("decimal needs a format, such as 06.2f")


def _garbled(why: str, data: bytes) -> Garbled:
    return Garbled(why, data, evidence=Evidence.SHAPE)
