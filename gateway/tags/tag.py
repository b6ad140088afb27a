"""Tags: their addresses and rules, and the conversion between units and values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, Literal, NamedTuple, TypeVar

from gateway.errors import BadValue, Garbled
from gateway.protocols.driver import Address, Span, Unit
from gateway.protocols.typed_fields import Shape
from gateway.tags.decoding import (
    Decode,
    WordPart,
    array_decoder,
    decoder,
    field_decoder,
    part_of,
    with_shaping,
)
from gateway.tags.formula import Formula
from gateway.tags.publishing import ON_CHANGE, Form, Publishing
from gateway.tags.scaling import Linear, exact_below, type_of, unscaled, unscaled_float
from gateway.tags.shaping import PLAIN, Shaping
from gateway.values import Layout, Value, to_words
from gateway.values.numerals import Scalar

# Larger whole numbers are refused at once: as many bits as the largest float has.
_MOST_BITS = 1024
F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class WriteRule:
    """Limits and options of writes. The limits are in the tag's own unit."""

    min: float | None = None
    max: float | None = None
    verify: bool = False  # read back after the acknowledgement and compare
    repeat: bool = False  # may be sent again after an unclear result
    latest: bool = False  # of several waiting writes only the latest is sent
    polled: bool = True  # False: it can only be written


class CounterRule(NamedTuple):
    """A counter has the values below `modulus`; a step of more than `most` is no count."""

    modulus: int
    most: int


@dataclass(frozen=True, slots=True)
class Label:
    """The words of a tag for people."""

    unit: str = ""
    description: str = ""


NotReal = Literal["simulated", "replayed"]  # instead of a device
OriginWord = NotReal | Literal["held", "computed"]


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of the values, where it is not the words at the address."""

    shape: Shape | None = None  # for a field of a frame: a read gives the value itself
    formula: Formula | None = None  # of a computed tag: no address, read or write
    # Seconds that a bit must stay, or the rule of a counter.
    kept: float | CounterRule | None = None
    # Of the formula, in its order; of a kept value the one tag with its reads. These are the tags
    # of another tag's value: this tag is not read itself.
    inputs: tuple["Tag", ...] = ()
    held: bool = False  # written by clients, for a master that reads it
    not_real: NotReal | None = None  # behind the port of the line

    @property
    def word(self) -> OriginWord | None:
        """Returns the word of the contract; None: a plain reading of a device."""
        if self.not_real is not None or self.held:
            return self.not_real or "held"
        counts = isinstance(self.kept, CounterRule)
        return "computed" if counts or self.formula is not None else None


READ = Origin()
_NO_LABEL = Label()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tag:
    """One value of one device: its address, type, interval and features.

    The value of an array is a tuple; all rules of values are those of each element.
    """

    device: str
    name: str
    text: str  # the address as the file writes it
    address: Address
    span: Span
    unit_kind: Unit
    layout: Layout
    every: float = 1.0
    shaping: Shaping = PLAIN
    publishing: Publishing = ON_CHANGE
    write: WriteRule | None = None
    origin: Origin = READ
    features: tuple[object, ...] = ()  # the settings of other features, one of each class
    key: str = field(init=False, repr=False)  # unique in the gateway: `device/name`
    # From the unit of the span to the value, or from its units if it has several.
    convert: Decode = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "key", f"{self.device}/{self.name}")
        object.__setattr__(self, "convert", self._decoder(self.shaping))

    @property
    def element(self) -> "Tag | None":
        """The first element of an array; None: it is no array. Each call makes another object."""
        if not (count := self.layout.type.count):
            return None
        span = self.span._replace(size=self.span.size // count)
        return replace(self, layout=self.layout.element, span=span)

    def _decoder(self, shaping: Shaping) -> Decode:
        if (element := self.element) is not None:
            return array_decoder(element._decoder(shaping), element.span.size)
        origin = self.origin
        if origin.formula is not None:
            return with_shaping(origin.formula.value, shaping)
        if origin.kept is not None:
            counter = isinstance(origin.kept, CounterRule)  # the reads of a bit are inverted
            return field_decoder(self.layout, self.line, shaping if counter else PLAIN)
        if origin.shape is not None:
            return field_decoder(self.layout, self.line, shaping)
        bit = self.address.bit
        return decoder(self.layout, self.unit_kind, self.single, bit, self.line, shaping)

    @property
    def line(self) -> Linear | None:
        """The scale and offset of a number; None: it has none."""
        return self.shaping.line if self.layout.type.is_number else None

    @property
    def part(self) -> WordPart | None:
        """The part of its word; None: whole words."""
        return part_of(self.layout, self.address.bit) if self.origin.shape is None else None

    def feature(self, kind: type[F]) -> F | None:
        """Returns the settings of a feature; None: the tag has it not."""
        for one in self.features:
            if isinstance(one, kind):
                return one
        return None

    @property
    def is_plain(self) -> bool:
        """True if a good value is published as JSON with quality and time, and nothing else."""
        names, clamp = self.shaping.names, self.shaping.clamp
        is_json = self.publishing.payload is Form.JSON
        return is_json and names is None and clamp is None and self.origin.word is None

    @property
    def is_scalar(self) -> bool:
        """True if a good value is one number or bit."""
        return not self.layout.type.count and not self.layout.type.is_text

    @property
    def polled(self) -> bool:
        """False if it is written, never read."""
        return self.write is None or self.write.polled

    @property
    def label(self) -> Label:
        return self.feature(Label) or _NO_LABEL

    def with_origin(self, word: NotReal | None) -> "Tag":
        """Returns the same tag of a device that is not real; None: itself."""
        return self if word is None else replace(self, origin=replace(self.origin, not_real=word))

    def copy(self, device: str, name: str) -> "Tag":
        """Returns the same tag under another name. Twenty times faster than `replace`."""
        twin = object.__new__(Tag)
        for put, value in zip(_PUTS, _values(self), strict=True):
            put(twin, value)
        object.__setattr__(twin, "device", device)
        object.__setattr__(twin, "name", name)
        object.__setattr__(twin, "key", f"{device}/{name}")
        if self.origin.inputs:
            inputs = tuple(one.copy(device, name) for one in self.origin.inputs)
            object.__setattr__(twin, "origin", replace(self.origin, inputs=inputs))
        return twin

    @property
    def single(self) -> bool:
        """True if `convert` takes one unit."""
        return self.origin.shape is not None or (self.span.size == 1 and not self.layout.type.count)

    def decode(self, units: Sequence[Any]) -> Value | None:
        """Returns the value of the units of the span; None: they hold none."""
        return self.convert(units[0] if self.single else units)

    def range_check(self) -> Callable[[Any], bool] | None:
        """Returns the function that finds a value outside the range of its sensor in what `convert`
        takes, also where the clamp hides it; None: each value is inside."""
        bounds = self.shaping.range
        if bounds is None:
            return None
        hides = self.shaping.clamp is not None
        convert = self._decoder(replace(self.shaping, clamp=None)) if hides else self.convert
        return lambda key: bounds.exclude(convert(key))

    @property
    def recorded_key(self) -> str:
        """The name of its samples in the history: simulated ones are never among real ones."""
        return self.key if (word := self.origin.not_real) is None else f"{self.key}@{word}"

    @property
    def exact_below(self) -> float | None:
        """The amount below which a JSON number tells all values apart; None: it always does."""
        line = self.line
        if line is None or self.layout.type.is_float:
            return None
        return exact_below(self.layout.type, line)

    @property
    def is_whole(self) -> bool:
        """True if it takes whole numbers only, as the device holds them."""
        kind = self.layout.type
        return self.line is None and kind.is_number and not kind.is_float

    @property
    def value_type(self) -> str:
        """The type of the value, which a scale can make another one than that of the device."""
        kind = self.layout.type
        of_one = type_of(kind.element, self.line)
        return f"{of_one}[{kind.count}]" if kind.count else of_one

    def encode(self, value: Value) -> list[int]:
        """Returns the units to write for `value`, of all elements of an array. Raises `BadValue`.

        A tag that is a part of a word gives that part alone: [0] or [1] for a bit.
        """
        if (element := self.element) is not None:
            return self._elements(element, value)
        if isinstance(value, tuple):
            raise BadValue(f"{self.name} has one value: send no list")
        return self._one(value)

    def _elements(self, element: "Tag", values: Value) -> list[int]:
        kind, units = self.layout.type, list[int]()
        if not isinstance(values, tuple):
            raise BadValue(f"{values!r} is no list: {self.name} is {kind}")
        if len(values) != kind.count:
            raise BadValue(f"a list of {len(values)} is written to {kind}: send {kind.count}")
        for place, value in enumerate(values):
            try:
                units += element.encode(value)
            except BadValue as error:
                raise BadValue(f"element {place}: {error}") from None
        return units

    def _one(self, value: Scalar) -> list[int]:
        if isinstance(value, int) and value.bit_length() > _MOST_BITS:
            raise BadValue("the number is too large")
        if self.shaping.names is not None:
            value = self.shaping.names.number(value)
        self._check_limits(value, str(value))
        value = self._shaped(self.shaping, value)
        if self.origin.shape is not None:
            return self._octets(self.origin.shape, value)
        words = to_words(self.layout)(self._unscaled(value))
        if self.unit_kind is Unit.DWORD:
            units = [low | high << 16 for low, high in zip(words[::2], words[1::2], strict=True)]
        else:
            units = words
        if self._rounds and (real := self.held(units)) is not None:
            self._check_limits(real, f"{value} (the device holds {real})")
        return units

    def _shaped(self, shaping: Shaping, value: Scalar) -> Scalar:
        """Returns the value before scaling, as a read would show it. Checks the limits again."""
        rounded = shaping.rounded(value)
        self._check_limits(rounded, f"{value} (rounded to {rounded})")
        shaping.check(rounded)
        if shaping.invert and isinstance(rounded, (bool, int)) and rounded in (0, 1):
            return not rounded
        return rounded

    def _octets(self, shape: Shape, value: Scalar) -> list[int]:
        """Returns the bytes of the value. Checks the limits again, as digits may round it."""
        octets = list(shape.put(self._unscaled(value)))
        real = self.held(octets)
        if real is None:
            raise BadValue(f"{value!r} cannot be read back after the write")
        self._check_limits(real, f"{value} (sent as {real})")
        return octets

    @property
    def _rounds(self) -> bool:
        """True when a write rounds the value to a step of the device."""
        return self.line is not None and not self.layout.type.is_float

    def _check_limits(self, value: Value, description: str) -> None:
        if self.write is None or isinstance(value, (bool, str, tuple)):
            return
        if self.write.min is not None and value < self.write.min:
            raise BadValue(f"{description} is below the least value {_short(self.write.min)}")
        if self.write.max is not None and value > self.write.max:
            raise BadValue(f"{description} is above the greatest value {_short(self.write.max)}")

    def from_units(self, units: Sequence[int]) -> Value | None:
        """Returns the value of units made by `encode`: the value that the device really gets."""
        if self.origin.shape is not None:
            try:
                return self.decode([self.origin.shape.take(bytes(units))])
            except Garbled:
                return None
        return self.decode(self._whole(units))

    def held(self, units: Sequence[int]) -> Value | None:
        """Returns `from_units` without rounding to decimals and without clamp."""
        if self.shaping.exact is self.shaping:
            return self.from_units(units)
        convert, whole = self._decoder(self.shaping.exact), self._whole(units)
        return convert(whole[0] if self.single else whole)

    def _whole(self, units: Sequence[int]) -> Sequence[int]:
        """Returns whole units for those of `encode`, which has only a part of a word."""
        part = self.part
        return units if part is None else [part.into(0, units[0])]

    def _unscaled(self, value: Scalar) -> Scalar:
        line = self.line
        if line is None or isinstance(value, (bool, str)):
            return value
        if self.layout.type.is_float:
            return unscaled_float(value, line)
        return unscaled(value, line)


_values = attrgetter(*Tag.__slots__)
_PUTS: list[Callable[[Tag, object], None]] = [vars(Tag)[slot].__set__ for slot in Tag.__slots__]


def _short(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.15g}"
