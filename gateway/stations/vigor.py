"""Vigor M, VB or VH PLCs: requests 51, 61, 70 and 71 of the Computer Link (manual B-5-2).

They find devices by the address map of the manual (B-5-3), independent of the driver. Errors: 10
for characters and lengths, 11 for a wrong sum, 12 for an unknown command, 28 for addresses.
"""

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

from gateway.protocols.checksums import byte_sum
from gateway.protocols.vigor import Vigor
from gateway.protocols.vigor.codec import (
    FORCE_OFF,
    FORCE_ON,
    GOOD,
    HEX_DIGITS,
    MOST_BYTES,
    READ,
    WRITE,
    Reply,
    RequestReader,
    encode,
)
from gateway.stations.station import Memory, MemoryStore
from gateway.stations.store import Cell, Denied, Rejected, Store, Written


class Stretch(NamedTuple):
    """Byte addresses `first` .. `last` and the devices they hold, from number `number` on."""

    first: int
    last: int
    area: str
    number: int
    width: int  # bytes of a device; 0 where a byte holds eight bits

    def devices(self, byte: int) -> range:
        """Returns the devices in a byte."""
        offset = byte - self.first
        if self.width:
            at = self.number + offset // self.width
            return range(at, at + 1)
        at = self.number + offset * 8
        return range(at, at + 8)

    def shift(self, byte: int) -> int:
        """The place of the byte in its register, in bits."""
        return 8 * ((byte - self.first) % self.width)


_STRETCHES = (
    Stretch(0x0000, 0x003F, "X", 0, 0),
    Stretch(0x0040, 0x007F, "Y", 0, 0),
    Stretch(0x0080, 0x02FF, "M", 0, 0),
    Stretch(0x0300, 0x037C, "S", 0, 0),
    Stretch(0x0380, 0x039F, "TS", 0, 0),
    Stretch(0x03A0, 0x03BF, "CS", 0, 0),
    Stretch(0x03E0, 0x03FF, "M9", 9000, 0),
    Stretch(0x0780, 0x079F, "TC", 0, 0),
    Stretch(0x07A0, 0x07BF, "CC", 0, 0),
    Stretch(0x1400, 0x15FF, "T", 0, 2),
    Stretch(0x1600, 0x17FF, "D9", 9000, 2),
    Stretch(0x1800, 0x198F, "C", 0, 2),
    Stretch(0x1A00, 0x1ADF, "C32", 200, 4),
    Stretch(0x1C00, 0x5BFF, "D", 0, 2),
)
_FORCED = ("X", "Y", "M", "S", "M9")
_ANY_CASE = b"0123456789ABCDEFabcdef"
_SHORTEST = 8  # characters of a request: station and command between STX and ETX, and the sum

_ASCII_ERROR, _BAD_SUM, _NO_COMMAND, _OUT_OF_RANGE = "10", "11", "12", "28"


def addressed(request: bytes) -> int | None:
    """Returns the station of a request; None where the number, or all of it, is damaged."""
    number = request[1:3]
    if len(request) < _SHORTEST or number.strip(_ANY_CASE):
        return None
    return int(number, 16)


def answer(station: int, store: Store, request: bytes) -> tuple[Reply, Written]:
    """Carries out a request. Checks in the order of the manual's codes."""
    content, check, command = request[1:-3], request[-2:], request[3:5].upper().decode("latin-1")
    status, data = GOOD, b""
    written: Written = ()
    if (content + check).translate(None, HEX_DIGITS):
        return Reply(station, command, _ASCII_ERROR), ()
    if byte_sum(request[1:-2]) != check:
        return Reply(station, command, _BAD_SUM), ()
    try:
        data, written = _carry_out(store, command, content[4:])
    except Rejected as rejected:
        status = rejected.code
    except Denied:
        status = _OUT_OF_RANGE
    return Reply(station, command, status, data), written


def _carry_out(store: Store, command: str, body: bytes) -> tuple[bytes, Written]:
    """Raises `Rejected`, `Denied`."""
    if command == READ:
        places = _places(body)
        if len(body) != 6:
            raise Rejected(_ASCII_ERROR)
        return read_stretches(store, places), ()
    if command == WRITE:
        places = _places(body)
        if len(body) != 6 + 2 * len(places):
            raise Rejected(_ASCII_ERROR)
        return b"", write_stretches(store, places, bytes.fromhex(body[6:].decode()))
    if command not in (FORCE_ON, FORCE_OFF):
        raise Rejected(_NO_COMMAND)
    if len(body) != 4:
        raise Rejected(_ASCII_ERROR)
    byte, bit = divmod(int(body, 16), 8)
    place = _stretch(byte)
    if place is None or place.area not in _FORCED:
        raise Rejected(_OUT_OF_RANGE)
    return b"", store.write([((place.area, place.devices(byte)[bit]), int(command == FORCE_ON))])


def _places(body: bytes) -> list[tuple[Stretch, int]]:
    """Returns the bytes of a 51 or 61."""
    if len(body) < 6:
        raise Rejected(_ASCII_ERROR)
    address, count = int(body[:4], 16), int(body[4:6], 16)
    if not 1 <= count <= MOST_BYTES:
        raise Rejected(_OUT_OF_RANGE)
    places = []
    for byte in range(address, address + count):
        place = _stretch(byte)
        if place is None:
            raise Rejected(_OUT_OF_RANGE)
        places.append((place, byte))
    return places


def read_stretches(store: Store, places: list[tuple[Stretch, int]]) -> bytes:
    data, words = bytearray(), dict[Cell, int]()
    for place, byte in places:
        devices = place.devices(byte)
        if not place.width:
            bits = store.read_points(place.area, devices[0], len(devices))
            data.append(sum((bit & 1) << i for i, bit in enumerate(bits)))
            continue
        cell = (place.area, devices[0])
        if cell not in words:
            words[cell] = store.read(*cell, 1)[0]
        data.append(words[cell] >> place.shift(byte) & 0xFF)
    return bytes(data)


def write_stretches(store: Store, places: list[tuple[Stretch, int]], data: bytes) -> Written:
    """Writes all bytes as one."""
    points: list[tuple[Cell, int]] = []
    words: dict[Cell, int] = {}
    missing: dict[Cell, int] = {}
    for (place, byte), value in zip(places, data, strict=True):
        devices = place.devices(byte)
        if not place.width:
            points += [((place.area, n), value >> bit & 1) for bit, n in enumerate(devices)]
            continue
        cell, shift = (place.area, devices[0]), place.shift(byte)
        words[cell] = words.get(cell, 0) | value << shift
        missing[cell] = missing.get(cell, (1 << 8 * place.width) - 1) & ~(0xFF << shift)
    lacking = {cell: bits for cell, bits in missing.items() if bits}
    return store.write([*words.items()], points, lacking)


class VigorStation:
    """A simulated PLC of station number 0..255, by default with every device of the address map.

    Memory areas: X Y M S T C D as in the manual (octal numbers as plain integers), TS CS the
    contacts and TC CC the coils of timers and counters, C32 the counters from C200 on (32 bits),
    M9 and D9 the special devices from 9000 on.
    """

    def __init__(self, station: int, holes: Iterable[Cell] = ()) -> None:
        """`holes`: devices (area, number) that this model lacks; the reply is 28."""
        if not 0 <= station <= 255:
            raise ValueError(f"station {station} is not 0..255")
        self.station = station
        self.mute = False  # carries out requests, but its replies are lost
        self.memory = Memory(
            ((place.area, place.number, place.devices(place.last)[-1]) for place in _STRETCHES),
            holes,
        )
        self._store = MemoryStore(self.memory)
        self._reader = RequestReader()

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the replies to the requests that `data` completes."""
        self._store.now = now
        requests = [one for one in self._reader.feed(data) if addressed(one) == self.station]
        replies = [answer(self.station, self._store, request)[0] for request in requests]
        return [] if self.mute else [encode(reply) for reply in replies]


def vigor_station(driver: Vigor) -> VigorStation:
    """Returns the station that the driver can talk to."""
    return VigorStation(driver.station)


@cache
def _stretch(byte: int) -> Stretch | None:
    """Returns the stretch of a byte address; None between two stretches."""
    return next((place for place in _STRETCHES if place.first <= byte <= place.last), None)
