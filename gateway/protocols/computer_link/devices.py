"""Liyan and Mitsubishi FX PLCs: device ranges, limits of the commands, names on the wire.

Liyan Computer Link manual 1-5 and chapter 2; Mitsubishi's ranges and limits after JY992D69901.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from gateway.protocols.devices import DeviceTable, device_table
from gateway.protocols.driver import Area, Unit

DEVICE = 5  # characters of a device on the wire

ProfileName = Literal["liyan", "ex1s", "ex1n", "ex2n", "fx"]


@dataclass(frozen=True, slots=True)
class Profile:
    """One maker's device ranges and the most that each command takes.

    `*_bits` are points, `*words` devices of 16 bits, `read_sixteens` words over bit devices,
    `dwords` counters of 32 bits, read or written.
    """

    areas: Mapping[str, Area]
    last_station: int
    read_bits: int  # BR
    write_bits: int  # BW
    dwords: int  # WR, WW
    loopback: int  # characters of TT
    monitored: int  # BM, WM; 0 where the PLC does not have them
    read_sixteens: int = 32  # WR; the Liyan manual allows 64, FX does not: 32 is safe with both
    words: int = 64  # WR, WW
    scattered_bits: int = 20  # BT
    scattered_words: int = 10  # WT
    table: DeviceTable = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "table", device_table(self.areas.values(), TN="T", CN="C"))


def _areas(last_xy: int, last_m: int, last_d: int) -> dict[str, Area]:
    areas = (
        Area("X", Unit.BIT, 0, last_xy, octal=True),
        Area("Y", Unit.BIT, 0, last_xy, octal=True),
        Area("M", Unit.BIT, 0, last_m),
        Area("M8", Unit.BIT, 8000, 8255),
        Area("S", Unit.BIT, 0, 999),
        Area("TS", Unit.BIT, 0, 255),
        Area("CS", Unit.BIT, 0, 255),
        Area("T", Unit.WORD, 0, 255),
        Area("C", Unit.WORD, 0, 199),
        Area("C32", Unit.DWORD, 200, 255),
        Area("D", Unit.WORD, 0, last_d),
        Area("D8", Unit.WORD, 8000, 8255),
    )
    return {area.name: area for area in areas}


def _liyan(last_xy: int) -> Profile:
    return Profile(
        _areas(last_xy, last_m=1535, last_d=3999),
        last_station=0x1F,
        read_bits=64,
        write_bits=64,
        dwords=16,
        loopback=128,
        monitored=10,
    )


_FX = Profile(
    _areas(0o267, last_m=3071, last_d=7999),
    last_station=0x0F,
    read_bits=256,
    write_bits=160,
    dwords=32,
    loopback=254,
    monitored=0,
)

PROFILES: Mapping[ProfileName, Profile] = {
    "liyan": _liyan(last_xy=0o177),
    "ex1s": _liyan(last_xy=0o17),
    "ex1n": _liyan(last_xy=0o177),
    "ex2n": _liyan(last_xy=0o177),
    "fx": _FX,
}

_CODES = {"M8": "M", "D8": "D", "T": "TN", "C": "CN", "C32": "CN"}


def wire_name(area: Area, number: int) -> str:
    """Returns the five characters of a device: X0017, M8030, TN123 (manual 1-5)."""
    code = _CODES.get(area.name, area.name)
    return f"{code}{number:0{DEVICE - len(code)}{'o' if area.octal else 'd'}}"
