"""The settings of a Modbus device, its areas, and the costs of its requests."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from gateway.errors import ConfigError
from gateway.protocols.driver import Address, Area, Cost, Span, Traits
from gateway.protocols.modbus.addressing import (
    EX485LNK,
    K120S,
    MODICON,
    PLAIN,
    VIGOR,
    Dialect,
    Limits,
    Place,
)
from gateway.values import Order

Addressing = Literal["plain", "vigor", "k120s", "ex485lnk"]
Numbering = Literal["zero_based", "modicon"]
WordOrder = Literal["low_first", "high_first"]

_DIALECTS = {"plain": PLAIN, "vigor": VIGOR, "k120s": K120S, "ex485lnk": EX485LNK}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """One device. Subclasses add the framing."""

    protocol: str
    station: int
    addressing: Addressing = "plain"
    numbering: Numbering = "zero_based"  # plain only: how registers are written in the file
    write_single: bool = True  # one unit by function 05 or 06; false: by 15 or 16
    diagnostics: bool = False  # the device has function 08, sub-function 0
    counter_word_order: WordOrder = "low_first"  # of Vigor's C200 to C255
    max_read_words: int | None = None
    max_read_bits: int | None = None
    max_write_words: int | None = None
    max_write_bits: int | None = None
    dialect: Dialect = field(init=False, repr=False, compare=False)
    limits: Limits = field(init=False, repr=False, compare=False)
    areas: Mapping[str, Area] = field(init=False, repr=False, compare=False)

    numbered: ClassVar[bool] = False  # requests carry a number
    _traits: ClassVar[Traits]

    def __post_init__(self) -> None:
        dialect = _DIALECTS[self.addressing]
        if self.numbering == "modicon":
            if dialect is not PLAIN:
                raise ConfigError("numbering: modicon goes with addressing: plain only")
            dialect = MODICON
        stations, usual = self._allowed(dialect)
        if self.station not in stations:
            raise ConfigError(f"station {self.station} is not {stations[0]}..{stations[-1]}")
        areas = [place.area for place in dialect.places.values()]
        if self.broadcast:
            areas = [replace(area, readable=False) for area in areas if area.writable]
        object.__setattr__(self, "dialect", dialect)
        object.__setattr__(self, "limits", self._limits(usual))
        object.__setattr__(self, "areas", {area.name: area for area in areas})

    def _allowed(self, dialect: Dialect) -> tuple[range, Limits]:
        """Returns the station numbers and the limits of a dialect. Raises `ConfigError`."""
        return dialect.stations, dialect.limits

    def _limits(self, usual: Limits) -> Limits:
        """Returns the limits of the file, and the usual ones for those not in the file."""
        limits: dict[str, int] = {}
        for name, default, most in zip(Limits._fields, usual, Limits(), strict=True):
            own: int | None = getattr(self, f"max_{name}")
            limits[name] = default if own is None else own
            if not 1 <= limits[name] <= most:
                raise ConfigError(f"max_{name} {limits[name]} is not 1..{most}")
        return Limits(**limits)

    @property
    def broadcast(self) -> bool:
        """True for station 0 of a line: every device listens, none replies."""
        return self.station == 0 and not self.numbered

    @property
    def traits(self) -> Traits:
        order = Order.HIGH_FIRST if self.addressing == "plain" else Order.LOW_FIRST
        return replace(self._traits, string_order=order)

    def chars(self, pdu_length: int) -> int:
        """Returns the characters of a frame around a PDU."""
        raise NotImplementedError

    def address(self, text: str) -> Address:
        return self.dialect.address(text)

    def spell(self, address: Address) -> str:
        return self.dialect.spell(address)

    def named(self, table: str, number: int) -> str:
        return self.dialect.named(table, number)

    def cost(self, span: Span) -> Cost | None:
        place = self.place_of(span)
        if place is None or self.broadcast:
            return None
        if span.size * place.registers > self.most(place, reading=True):
            return None
        data = (span.size + 7) // 8 if place.of_bits else 2 * span.size * place.registers
        return Cost(self.chars(5), self.chars(2 + data))

    def write_cost(self, span: Span) -> Cost | None:
        place = self.place_of(span)
        if place is None or not place.area.writable:
            return None
        if span.size * place.registers > self.most(place, reading=False):
            return None
        data = (span.size + 7) // 8 if place.of_bits else 2 * span.size * place.registers
        request = 5 if self.is_single(place, span) else 6 + data
        return Cost(self.chars(request), 0 if self.broadcast else self.chars(5))

    def place_of(self, span: Span) -> Place | None:
        place = self.dialect.places.get(span.area)
        return place if place is not None and place.area.holds(span) else None

    def most(self, place: Place, *, reading: bool) -> int:
        limits = self.limits
        if place.of_bits:
            return limits.read_bits if reading else limits.write_bits
        return limits.read_words if reading else limits.write_words

    def is_single(self, place: Place, span: Span) -> bool:
        single = self.write_single and self.dialect.single_writes
        return single and span.size == 1 and place.registers == 1
