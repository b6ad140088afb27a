"""The manners of stations: how they refuse, and which addresses they have.

Manuals leave both open. A station may be silent about an address that it does not have, or refuse
it with another code than the usual one, and it may have no address but the configured ones.
"""

import random
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from gateway.protocols.computer_link.codec import Nak
from gateway.protocols.driver import Span, Unit
from gateway.protocols.modbus import Frame
from gateway.protocols.vigor.codec import Reply, encode
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.modbus import ModbusStation
from gateway.stations.station import Station
from gateway.stations.vigor import VigorStation
from gateway.tags import Tag

SILENT = "silent"
USUAL = {"modbus": "02", "vigor": "28", "computer-link": "06"}  # codes for unknown addresses
OTHERS = {
    "modbus": ("01", "03", "04"),
    "vigor": ("12", "33"),
    "computer-link": ("03", "07", "10"),
}
BUSY = {"modbus": "06", "vigor": "12", "computer-link": "10"}  # while it starts, say
LAST = 100_000  # above every address


@dataclass(frozen=True)
class Manners:
    """`unknown`: the code for an unknown address, or `silent`; empty: as the manual has it.

    `has`: `range`, it has no address below the first and above the last tag of an area;
    `tags`, it has those of its tags alone; empty: all that the manual names. `single`: it
    ignores a request that arrives before its reply to the one before.
    """

    unknown: str = ""
    has: str = ""
    single: bool = False


def manners_of(device: dict[str, Any], chance: random.Random) -> Manners:
    """Draws the manners of a device in the file."""
    family = device["protocol"].split("-")[0]
    family = "computer-link" if family == "computer" else family
    other = chance.choice(OTHERS.get(family, ("",)))
    unknown = chance.choice(("", "", SILENT, other))
    has = chance.choice(("", "", "range", "tags"))
    single = chance.random() < 0.4
    if family == "frames":
        return Manners()
    return Manners(unknown, has, single and device.get("window", 1) > 1)


@dataclass(frozen=True)
class Holes:
    """Addresses (area, number), and ranges of them."""

    numbers: frozenset[tuple[str, int]]
    ranges: tuple[tuple[str, int, int], ...]

    def __bool__(self) -> bool:
        return bool(self.numbers or self.ranges)

    def __contains__(self, cell: tuple[str, int]) -> bool:
        area, number = cell
        return cell in self.numbers or any(
            area == name and first <= number <= last for name, first, last in self.ranges
        )


def outside(has: str, tags: Iterable[Tag], areas: Iterable[str]) -> list[tuple[str, int, int]]:
    """Returns the addresses that the station lacks beside those of its tags, as ranges."""
    found = []
    for area in areas if has else ():
        spans = sorted(_bytewise(tag) for tag in tags if tag.span.area == area)
        if has == "range" and spans:
            ends = max(span.start + span.size for span in spans)
            found += [(area, 0, spans[0].start - 1), (area, ends, LAST)]
            continue
        free = 0
        for span in spans:
            if free < span.start:
                found.append((area, free, span.start - 1))
            free = max(free, span.start + span.size)
        found.append((area, free, LAST))
    return found


def _bytewise(tag: Tag) -> Span:
    """Returns the span of a tag; PLCs have bit devices in words."""
    area, start, size = tag.span
    if tag.unit_kind is not Unit.BIT:
        return tag.span
    first, last = start // 16 * 16, start + size - 1
    if tag.layout.type.count:
        last = last // 8 * 8 + 15  # a word of bits can begin in the middle of another one
    return Span(area, first, (last + 16) // 16 * 16 - first)


def is_unknown(inner: Station, reply: bytes) -> bool:
    """The reply refuses an address."""
    match inner:
        case ModbusStation():
            _, _, pdu = _parts(inner, reply)
            return len(pdu) == 2 and pdu[0] >= 0x80 and pdu[1] == 2
        case VigorStation():
            return reply[5:7] == b"28"
        case ComputerLinkStation():
            return reply[:1] == b"\x15" and b"06" in reply[5:7]
    return False


_OTHER_READ = {3: 4, 4: 3}


def refusal(inner: Station, reply: bytes, code: str) -> bytes:
    """Returns the refusal with this code in place of the reply."""
    match inner:
        case ModbusStation():
            station, number, pdu = _parts(inner, reply)
            confused = station % 4 == 3  # it names function 04 for 03, and 03 for 04
            function = _OTHER_READ.get(pdu[0], pdu[0]) if confused else pdu[0]
            said = bytes((function | 0x80, int(code, 16)))
            return inner._codec.encode(Frame(station, said, number))  # private: its framing
        case VigorStation():
            return encode(Reply(inner.station, reply[3:5].decode("latin-1"), code, b""))
        case ComputerLinkStation():
            return inner._encode(Nak(inner.station, code))  # private: its format
    return reply


def _parts(station: ModbusStation, reply: bytes) -> tuple[int, int, bytes]:
    """Returns the station, the number and the PDU of a reply."""
    match station.framing:
        case "tcp":
            return reply[6], int.from_bytes(reply[:2], "big"), reply[7:]
        case "ascii":
            raw = bytes.fromhex(reply[1:-2].decode())
            return raw[0], 0, raw[1:-1]
    return reply[0], 0, reply[1:-2]
