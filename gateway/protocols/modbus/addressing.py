"""The names of data in each kind of Modbus slave, and their wire addresses.

Wire addresses always count from zero; device names may not.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from gateway.errors import ConfigError
from gateway.protocols.devices import DeviceTable, device_table, parse_device, spell_device
from gateway.protocols.driver import Address, Area, Unit
from gateway.protocols.modbus.frame import READ_BITS


class Place(NamedTuple):
    """The place of an area: the wire address of its first unit, and the function that reads it."""

    area: Area
    wire: int
    function: int

    @property
    def registers(self) -> int:
        """Wire addresses per unit."""
        return 2 if self.area.unit is Unit.DWORD else 1

    @property
    def of_bits(self) -> bool:
        return self.function in READ_BITS

    def at(self, number: int) -> int:
        return self.wire + (number - self.area.first) * self.registers


class Limits(NamedTuple):
    """The most units of one request."""

    read_words: int = 125
    read_bits: int = 2000
    write_words: int = 123
    write_bits: int = 1968


@dataclass(frozen=True, slots=True)
class Dialect:
    """The addresses and the limits of one kind of slave."""

    places: Mapping[str, Place]
    address: Callable[[str], Address]
    spell: Callable[[Address], str]
    stations: range = range(248)
    any_unit: bool = True  # on Modbus TCP, where the station is a unit identifier: 0 to 255
    limits: Limits = Limits()  # noqa: RUF009 - an immutable tuple
    ascii_limits: Limits = Limits()  # noqa: RUF009 - an immutable tuple
    single_writes: bool = True  # functions 05 and 06 are served
    rtu_silence: float = 0.0  # seconds, where the device needs more than the standard
    standard: bool = False  # it may have functions 17, 22 and 43
    forgets_address: bool = False  # replies to function 06 may have address 0

    def named(self, table: str, number: int) -> str:
        """Returns the name of a zero-based wire address in a table of the standard: `holding`, 0.

        Raises `ConfigError`.
        """
        function = _PLAIN[table].function
        for place in self.places.values():
            ahead, odd = divmod(number - place.wire, place.registers)
            address = Address(place.area.name, place.area.first + ahead)
            if place.function == function and ahead >= 0 and address.number <= place.area.last:
                if odd:
                    raise ConfigError(f"{table}:{number} is the second half of a counter")
                return self.spell(address)
        raise ConfigError(f"{table}:{number} is no address of this device")


def _by_name(*places: Place) -> dict[str, Place]:
    return {place.area.name: place for place in places}


def _bit(text: str, digits: str | None, area: Area) -> int | None:
    if digits is None:
        return None
    if area.unit is not Unit.WORD:
        raise ConfigError(f"{text}: this is a bit already, leave out .{digits}")
    if int(digits) > 15:
        raise ConfigError(f"{text}: the bits of a word are .0 to .15")
    return int(digits)


def _suffix(address: Address) -> str:
    return "" if address.bit is None else f".{address.bit}"


# ---- plain: the four tables of the standard --------------------------------------------

_PLAIN = _by_name(
    Place(Area("holding", Unit.WORD, 0, 65535), 0, 3),
    Place(Area("input", Unit.WORD, 0, 65535, writable=False), 0, 4),
    Place(Area("coil", Unit.BIT, 0, 65535), 0, 1),
    Place(Area("discrete", Unit.BIT, 0, 65535, writable=False), 0, 2),
)
_ZERO_BASED = re.compile(r"(holding|input|coil|discrete):([0-9]{1,6})(?:\.([0-9]{1,2}))?")
_MODICON = re.compile(r"([0134])([0-9]{4,5})(?:\.([0-9]{1,2}))?")
_MODICON_AREAS = {"0": "coil", "1": "discrete", "3": "input", "4": "holding"}
_MODICON_DIGITS = {area: digit for digit, area in _MODICON_AREAS.items()}


def _plain(text: str) -> Address:
    match = _ZERO_BASED.fullmatch(text)
    if match is None:
        hint = "; 40101 style needs `numbering: modicon`" if _MODICON.fullmatch(text) else ""
        raise ConfigError(
            f"{text!r} is no Modbus address: write holding:100, input:100, coil:5 or "
            f"discrete:7, counted from zero, a bit of a word as holding:100.3{hint}"
        )
    area, number = _PLAIN[match[1]].area, int(match[2])
    if number > area.last:
        raise ConfigError(f"{text}: wire addresses go from 0 to {area.last}")
    return Address(area.name, number, _bit(text, match[3], area))


def _spell_plain(address: Address) -> str:
    return f"{address.area}:{address.number}{_suffix(address)}"


def _modicon(text: str) -> Address:
    match = _MODICON.fullmatch(text)
    if match is None:
        raise ConfigError(
            f"{text!r} is no Modicon number: write 40101 (or 400101) for a holding register, "
            "30101 an input register, 10101 a discrete input, 00101 a coil, counted from 1"
        )
    area, number = _PLAIN[_MODICON_AREAS[match[1]]].area, int(match[2])
    if not 1 <= number <= 65536:
        raise ConfigError(f"{text}: the digits after the first go from 0001 to 65536")
    return Address(area.name, number - 1, _bit(text, match[3], area))


def _spell_modicon(address: Address) -> str:
    digit, number = _MODICON_DIGITS[address.area], address.number + 1
    return f"{digit}{number:04d}{_suffix(address)}"


PLAIN = Dialect(_PLAIN, _plain, _spell_plain, standard=True)
MODICON = Dialect(_PLAIN, _modicon, _spell_modicon, standard=True)

# ---- EX485LNK: raw registers, 32 words, 10 ms of silence (manual 2.4, 2.5) ---------------

_EX485LNK = _by_name(Place(Area("holding", Unit.WORD, 0, 65535), 0, 3))
_BFM = re.compile(r"(?:holding:|BFM#)([0-9]{1,6})(?:\.([0-9]{1,2}))?")


def _ex485lnk(text: str) -> Address:
    match = _BFM.fullmatch(text)
    if match is None:
        raise ConfigError(f"{text!r} is no register: write holding:4 or BFM#4")
    area, number = _EX485LNK["holding"].area, int(match[1])
    if number > area.last:
        raise ConfigError(f"{text}: registers go from 0 to {area.last}")
    return Address(area.name, number, _bit(text, match[2], area))


EX485LNK = Dialect(
    _EX485LNK,
    _ex485lnk,
    _spell_plain,
    limits=Limits(read_words=32, write_words=32),
    ascii_limits=Limits(read_words=32, write_words=32),
    single_writes=False,
    rtu_silence=0.010,
)

# ---- Vigor M, VB, VH as slave on CP2 -----------------------------------------------------
# The manual's 5-digit numbers are a type digit and the zero-based wire address: 40000 is D0.
# No wire addresses: coils 6632-6655 and 7168-7423. Coils of T and C are not mapped.

_VIGOR = _by_name(
    Place(Area("X", Unit.BIT, 0, 0o777, octal=True, writable=False), 0, 2),
    Place(Area("Y", Unit.BIT, 0, 0o777, octal=True), 0, 1),
    Place(Area("M", Unit.BIT, 0, 5119), 512, 1),
    Place(Area("S", Unit.BIT, 0, 999), 5632, 1),
    Place(Area("TS", Unit.BIT, 0, 255), 6656, 1),
    Place(Area("CS", Unit.BIT, 0, 255), 6912, 1),
    Place(Area("M9", Unit.BIT, 9000, 9255), 7424, 1),
    Place(Area("D", Unit.WORD, 0, 8191), 0, 3),
    Place(Area("T", Unit.WORD, 0, 255), 8192, 3),
    Place(Area("C", Unit.WORD, 0, 199), 8448, 3),
    Place(Area("C32", Unit.DWORD, 200, 255), 8648, 3),
    Place(Area("D9", Unit.WORD, 9000, 9255), 8760, 3),
)


def _table(places: Mapping[str, Place]) -> DeviceTable:
    areas = (place.area for place in places.values() if not place.area.name.endswith("W"))
    return device_table(areas, TN="T", CN="C")


_VIGOR_DEVICES = _table(_VIGOR)
VIGOR = Dialect(
    _VIGOR,
    lambda text: parse_device(text, _VIGOR_DEVICES),
    lambda address: spell_device(address, _VIGOR_DEVICES),
    forgets_address=True,
)

# ---- LG/LS MASTER-K120S ------------------------------------------------------------------
# P, M, L, K, F are 16-bit words whose bits have numbers of their own: M0010 is word 001, bit 0.
# The map has 256 words of each; the PLC refuses those that it does not have (exception 02). F has
# 64 words, and the manual (8.3.4) writes its flags without the leading zero: F110 is bit F0110.

_RELAYS = "PMLKF"


def _relay(letter: str, base: int) -> tuple[Place, Place]:
    writable, words = letter != "F", 64 if letter == "F" else 256
    return (
        Place(Area(letter, Unit.BIT, 0, words * 16 - 1, writable=writable), base, 1),
        Place(Area(f"{letter}W", Unit.WORD, 0, words - 1, writable=writable), base, 3),
    )


_K120S = _by_name(
    *_relay("P", 0x0000),
    *_relay("M", 0x1000),
    *_relay("L", 0x2000),
    *_relay("K", 0x3000),
    *_relay("F", 0x4000),
    Place(Area("TS", Unit.BIT, 0, 255), 0x5000, 1),
    Place(Area("T", Unit.WORD, 0, 255), 0x5000, 3),
    Place(Area("CS", Unit.BIT, 0, 255), 0x6000, 1),
    Place(Area("C", Unit.WORD, 0, 255), 0x6000, 3),
    Place(Area("S", Unit.WORD, 0, 99), 0x7000, 3),
    Place(Area("D", Unit.WORD, 0, 4999), 0x8000, 3),
)
_K120S_DEVICES = _table(_K120S)  # with the relays for its messages: `_k120s` reads these
_K120S_WIDTHS = {"T": 3, "C": 3, "TS": 3, "CS": 3, "S": 2, "D": 4}
_K120S_RELAY = re.compile(r"([PMLKF])([0-9]{3})(?:([0-9A-F])|\.([0-9]{1,2}))?")


def _k120s(text: str) -> Address:
    name = text.upper()
    if not name.startswith(tuple(_RELAYS)):
        return parse_device(text, _K120S_DEVICES)
    match = _K120S_RELAY.fullmatch(name)
    if match is None:
        letter = name[0]
        raise ConfigError(
            f"{text!r}: write the bits of {letter} with three digits for the word and a hex "
            f"digit for the bit ({letter}0010, {letter}001F), its words with three ({letter}001)"
        )
    word = int(match[2])
    area = _K120S[f"{match[1]}W"].area
    if match[1] == "F" and len(name) == 4 and area.last < word <= area.last * 10 + 9:
        return Address("F", word // 10 * 16 + word % 10)
    if word > area.last:
        raise ConfigError(f"{text}: the words of {match[1]} go from 000 to {area.last:03}")
    if match[3] is not None:
        return Address(match[1], word * 16 + int(match[3], 16))
    return Address(area.name, word, _bit(text, match[4], area))


def _spell_k120s(address: Address) -> str:
    area, number, _ = address
    if area in _RELAYS:
        return f"{area}{number // 16:03d}{number % 16:X}"
    letters, width = (area[0], 3) if area.endswith("W") else (area, _K120S_WIDTHS[area])
    return f"{letters}{number:0{width}d}{_suffix(address)}"


# ASCII frames are at most 128 characters: 11 + 4n of them for reading n words, 19 + 4n for writing.
K120S = Dialect(
    _K120S,
    _k120s,
    _spell_k120s,
    stations=range(1, 32),
    any_unit=False,
    ascii_limits=Limits(read_words=29, read_bits=464, write_words=27, write_bits=432),
)
