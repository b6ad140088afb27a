"""Tags and their samples: what a device has to say, and how well we know it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

from gateway.errors import BadValue, Garbled
from gateway.protocols.driver import Address, Span, Unit
from gateway.values import Kind, Layout, Value, from_words, to_words

# Of a whole number that is worth looking at: as many as the largest float has.
_MOST_BITS = 1024


class Quality(StrEnum):
    GOOD = "good"
    BAD = "bad"


class Reason(StrEnum):
    """Why a value is not known."""

    STARTING = "starting"  # not read yet
    NO_REPLY = "no-reply"  # the device is silent
    GARBLED = "garbled"  # the device answers, but nothing that can be understood
    REFUSED = "refused"  # the device answers "no": this address does not exist there
    LINE_DOWN = "line-down"  # the port is gone
    OVERDUE = "overdue"  # the device answers, but this was not asked for too long
    DISABLED = "disabled"  # switched off in the file
    NOT_A_NUMBER = "not-a-number"  # read well, but no value of the tag's type (NaN, bad BCD)


class Publish(StrEnum):
    CHANGE = "change"
    ALWAYS = "always"


class Form(StrEnum):
    """How a value travels."""

    JSON = "json"  # with quality and time
    RAW = "raw"  # the bare value


class Deadband(NamedTuple):
    """A change smaller than this is not published. `percent`: of the last published value."""

    amount: float
    percent: bool = False


@dataclass(frozen=True, slots=True)
class WriteRule:
    """What may be written, and how: bounds are in the tag's own units."""

    min: float | None = None
    max: float | None = None
    verify: bool = False  # read back after the acknowledgement and compare
    repeat: bool = False  # may be sent again when nobody knows whether it was done
    latest: bool = False  # of several waiting writes only the last is sent


class Shape(Protocol):
    """How a value lies in a frame of a no-protocol device, which has no words."""

    def put(self, value: Value) -> bytes:
        """Its bytes. Raises `BadValue`."""

    def take(self, raw: bytes) -> Value:
        """What such bytes mean. Raises `Garbled`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tag:
    """One value of one device: where it lives, how to read it, how often, who may write it."""

    device: str
    name: str
    text: str  # the address as the file writes it
    address: Address
    span: Span
    unit_kind: Unit
    layout: Layout
    every: float = 1.0
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    description: str = ""
    deadband: Deadband | None = None
    publish: Publish = Publish.CHANGE
    heartbeat: float | None = None
    history: bool = False
    payload: Form = Form.JSON
    write: WriteRule | None = None
    shape: Shape | None = None  # of a field of a frame: what is read is its value itself
    event: bool = False  # every value counts, also one that is equal to the last
    decode: Callable[[Sequence[Any]], Value | None] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        scale, offset = float(self.scale), float(self.offset)
        decode: Callable[[Sequence[Any]], Value | None]
        if self.shape is None:
            decode = _decoder(self.layout, self.unit_kind, self.address.bit, scale, offset)
        else:
            decode = _passed_on(self.layout, scale, offset)
        object.__setattr__(self, "decode", decode)

    @property
    def key(self) -> str:
        """Unique in the gateway: `device/name`."""
        return f"{self.device}/{self.name}"

    def encode(self, value: Value) -> list[int]:
        """The units to write for `value`. Raises `BadValue` before anything is sent.

        For one bit of a word it is the bit alone: [0] or [1].
        """
        if isinstance(value, int) and value.bit_length() > _MOST_BITS:
            raise BadValue("the number is too large")
        self._keep_limits(value, str(value))
        if self.shape is not None:
            return self._octets(self.shape, value)
        words = to_words(self.layout)(self._unscaled(value))
        if self.unit_kind is Unit.DWORD:
            units = [low | high << 16 for low, high in zip(words[::2], words[1::2], strict=True)]
        else:
            units = words
        if self._rounds and (real := self.from_units(units)) is not None:
            self._keep_limits(real, f"{value} (the device holds {real})")
        return units

    def _octets(self, shape: Shape, value: Value) -> list[int]:
        """The bytes of the value in its frame, whose digits may say a little less than it."""
        octets = list(shape.put(self._unscaled(value)))
        real = self.from_units(octets)
        if real is None:
            raise BadValue(f"{value!r} cannot be written so that it could be read again")
        self._keep_limits(real, f"{value} (what is sent is {real})")
        return octets

    @property
    def _rounds(self) -> bool:
        """Whether a value moves to the device's next step when it is written."""
        scaled = self.scale != 1 or self.offset != 0
        return scaled and self.layout.type.is_number and not _is_float(self.layout)

    def _keep_limits(self, value: Value, told: str) -> None:
        if self.write is None or isinstance(value, (bool, str)):
            return
        if self.write.min is not None and value < self.write.min:
            raise BadValue(f"{told} is below the least value {_short(self.write.min)}")
        if self.write.max is not None and value > self.write.max:
            raise BadValue(f"{told} is above the greatest value {_short(self.write.max)}")

    def from_units(self, units: Sequence[int]) -> Value | None:
        """The value that `encode` made these units from: what really goes to the device."""
        if self.shape is not None:
            try:
                return self.decode([self.shape.take(bytes(units))])
            except Garbled:
                return None
        if self.address.bit is not None:
            return bool(units[0])
        return self.decode(units)

    def _unscaled(self, value: Value) -> Value:
        if not self.layout.type.is_number or isinstance(value, (bool, str)):
            return value
        if self.scale == 1 and self.offset == 0:
            return value
        try:
            raw = (value - self.offset) / self.scale
        except OverflowError:
            raise BadValue(f"{value} is too large") from None
        if _is_float(self.layout):
            return raw
        if not math.isfinite(raw):
            raise BadValue(f"{value} is no finite number")
        return round(raw)


def _short(number: float) -> str:
    return f"{number:.15g}"


def _is_float(layout: Layout) -> bool:
    return layout.type.kind in (Kind.FLOAT32, Kind.FLOAT64)


def _decimals(number: float) -> int:
    """The decimals of a number as a person wrote it: 0.1 -> 1, 2 -> 0, 1e-05 -> 5."""
    mantissa, _, exponent = repr(number).partition("e")
    fraction = mantissa.partition(".")[2].rstrip("0")
    return max(0, len(fraction) - int(exponent or 0))


@lru_cache(maxsize=4096)
def _decoder(
    layout: Layout, unit: Unit, bit: int | None, scale: float, offset: float
) -> Callable[[Sequence[int]], Value | None]:
    """One compiled function per kind of tag, shared by all tags of that kind."""
    if bit is not None:
        return lambda units: bool(units[0] >> bit & 1)
    plain = from_words(layout)
    if unit is Unit.DWORD:
        narrow = plain

        def plain(units: Sequence[int]) -> Value | None:
            return narrow([half for word in units for half in (word & 0xFFFF, word >> 16)])

    if (scale == 1 and offset == 0) or not layout.type.is_number:
        return plain
    decimals = max(_decimals(scale), _decimals(offset))
    exact = not _is_float(layout)

    def scaled(units: Sequence[int]) -> Value | None:
        raw = plain(units)
        if raw is None or isinstance(raw, str):
            return raw
        value = raw * scale + offset
        if not math.isfinite(value):
            return None
        # 123 x 0.1 is 12.3 to a person; binary fractions would make it 12.3000000000000007.
        return round(value, decimals) if exact else value

    return scaled


@lru_cache(maxsize=4096)
def _passed_on(
    layout: Layout, scale: float, offset: float
) -> Callable[[Sequence[Any]], Value | None]:
    """For what is a value already, or the `Garbled` that says why there is none."""
    scales = layout.type.is_number and not (scale == 1 and offset == 0)
    exact = not _is_float(layout)
    decimals = max(_decimals(scale), _decimals(offset))

    def value(units: Sequence[Any]) -> Value | None:
        raw: Value | Garbled = units[0]
        if isinstance(raw, Garbled):
            return None
        if not scales or isinstance(raw, str):
            return raw
        scaled = raw * scale + offset
        if not math.isfinite(scaled):
            return None
        # Written in digits, as its device did: 600.0 x 0.1 is 60, not 60.00000000000001.
        return round(scaled, decimals) if exact else float(f"{scaled:.15g}")

    return value


class Sample(NamedTuple):
    """What is known of a tag: a value that was in the device at `time`, or why there is none.

    `time` is nanoseconds since 1970, UTC: when the reply arrived, or when it became bad.
    """

    tag: Tag
    value: Value | None
    quality: Quality
    time: int
    reason: Reason | None = None
    detail: str = ""  # one plain sentence for people, where there is one


def good(tag: Tag, value: Value, time: int) -> Sample:
    return Sample(tag, value, Quality.GOOD, time)


def of_field(tag: Tag, value: Value | Garbled, time: int) -> Sample:
    """What a frame said of a tag."""
    if isinstance(value, Garbled):
        return bad(tag, Reason.GARBLED, time, str(value))
    known = tag.decode([value])
    return bad(tag, Reason.NOT_A_NUMBER, time) if known is None else good(tag, known, time)


def bad(tag: Tag, reason: Reason, time: int, detail: str = "") -> Sample:
    return Sample(tag, None, Quality.BAD, time, reason, detail)


class WriteResult(NamedTuple):
    """A write that was done: what the device now holds, as far as it told us."""

    value: Value
    time: int  # ns since 1970: when it was acknowledged
    took: float  # seconds from submitting to the acknowledgement
    verified: bool = False  # read back, and so it is
    acknowledged: bool = True  # False only for a broadcast, which nobody acknowledges
