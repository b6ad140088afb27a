"""A simulated Vigor M, VB or VH PLC: replies to computer link requests from its device memory.

It finds devices by the address map of the manual (B-5-3), independent of the driver.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from typing import NamedTuple

from gateway.protocols.checksums import byte_sum
from gateway.protocols.vigor import Vigor
from gateway.protocols.vigor.codec import HEX_DIGITS, Reply, RequestReader, encode
from gateway.stations.station import Memory


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
FORCED = ("X", "Y", "M", "S", "M9")
_ANY_CASE = b"0123456789ABCDEFabcdef"

_DONE, _ASCII_ERROR, _BAD_SUM, _NO_COMMAND, _OUT_OF_RANGE = "00", "10", "11", "12", "28"


class VigorStation:
    """A PLC of station number 0..255, by default with every device of the address map.

    Memory areas: X Y M S T C D as in the manual (octal numbers as plain integers), TS CS the
    contacts and TC CC the coils of timers and counters, C32 the counters from C200 on (32 bits),
    M9 and D9 the special devices from 9000 on.
    """

    def __init__(self, station: int, holes: Iterable[tuple[str, int]] = ()) -> None:
        """`holes`: devices (area, number) that this model lacks; the reply is 28."""
        if not 0 <= station <= 255:
            raise ValueError(f"station {station} is not 0..255")
        self.station = station
        self.holes = set(holes)
        self.mute = False  # carries out requests, but its replies are lost
        self._reader = RequestReader()
        self._memory = Memory(
            (place.area, place.number, place.devices(place.last)[-1]) for place in _STRETCHES
        )

    @property
    def memory(self) -> Memory:
        return self._memory

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the replies to the requests that `data` completes."""
        replies = [self._answer(request, now) for request in self._reader.feed(data)]
        return [] if self.mute else [encode(reply) for reply in replies if reply is not None]

    def _answer(self, request: bytes, now: float) -> Reply | None:
        """Returns None for a request to another station, or one too damaged for any station."""
        station, command = request[1:3], request[3:5].upper()
        content, check = request[1:-3], request[-2:]
        if len(content) < 4 or station.strip(_ANY_CASE) or int(station, 16) != self.station:
            return None
        status, data = _DONE, b""
        if (content + check).translate(None, HEX_DIGITS):
            status = _ASCII_ERROR
        elif byte_sum(request[1:-2]) != check:
            status = _BAD_SUM
        else:
            status, data = self._carry_out(command, content[4:], now)
        return Reply(self.station, command.decode("latin-1"), status, data)

    def _carry_out(self, command: bytes, body: bytes, now: float) -> tuple[str, bytes]:
        """Returns status and data for a whole request."""
        match command:
            case b"51":
                return self._read(body, now)
            case b"61":
                return self._write(body, now), b""
            case b"70" | b"71":
                return self._force(body, int(command == b"70")), b""
        return _NO_COMMAND, b""

    def _read(self, body: bytes, now: float) -> tuple[str, bytes]:
        if len(body) < 6:
            return _ASCII_ERROR, b""
        places = self._places(body)
        if places is None:
            return _OUT_OF_RANGE, b""
        if len(body) > 6:
            return _ASCII_ERROR, b""
        return _DONE, bytes(self._peek(place, byte, now) for place, byte in places)

    def _write(self, body: bytes, now: float) -> str:
        if len(body) < 6:
            return _ASCII_ERROR
        places = self._places(body)
        if places is None:
            return _OUT_OF_RANGE
        if len(body) != 6 + 2 * len(places):
            return _ASCII_ERROR
        data = bytes.fromhex(body[6:].decode("ascii"))
        for (place, byte), value in zip(places, data, strict=True):
            self._poke(place, byte, value, now)
        return _DONE

    def _force(self, body: bytes, value: int) -> str:
        if len(body) != 4:
            return _ASCII_ERROR
        byte, bit = divmod(int(body, 16), 8)
        place = stretch(byte)
        if place is None or place.area not in FORCED:
            return _OUT_OF_RANGE
        number = place.devices(byte)[bit]
        if self._lacks(place.area, (number,)):
            return _OUT_OF_RANGE
        self._memory.write(place.area, number, [value])
        return _DONE

    def _places(self, body: bytes) -> list[tuple[Stretch, int]] | None:
        """Returns the bytes of a 51 or 61; None for zero, too many, or some that do not exist."""
        address, count = int(body[:4], 16), int(body[4:6], 16)
        if not 1 <= count <= 128:
            return None
        places = []
        for byte in range(address, address + count):
            place = stretch(byte)
            if place is None:
                return None
            if self._lacks(place.area, place.devices(byte)):
                return None
            places.append((place, byte))
        return places

    def _lacks(self, area: str, numbers: Sequence[int]) -> bool:
        if self.holes and any((area, number) in self.holes for number in numbers):
            return True
        return self._memory.guard is not None and self._memory.guard(area, numbers)

    def _peek(self, place: Stretch, byte: int, now: float) -> int:
        devices = place.devices(byte)
        values = self._memory.read(place.area, devices[0], len(devices), now)
        if place.width:
            return values[0] >> place.shift(byte) & 0xFF
        return sum((value & 1) << bit for bit, value in enumerate(values))

    def _poke(self, place: Stretch, byte: int, value: int, now: float) -> None:
        devices = place.devices(byte)
        if not place.width:
            self._memory.write(place.area, devices[0], [value >> bit & 1 for bit in range(8)])
            return
        shift = place.shift(byte)
        register = self._memory.read(place.area, devices[0], 1, now)[0]
        kept = register & ~(0xFF << shift) & (1 << 8 * place.width) - 1
        self._memory.write(place.area, devices[0], [kept | value << shift])


def vigor_station(driver: Vigor) -> VigorStation:
    """Returns the station that the driver can talk to."""
    return VigorStation(driver.station)


@cache
def stretch(byte: int) -> Stretch | None:
    """Returns the stretch of a byte address; None between two stretches."""
    return next((place for place in _STRETCHES if place.first <= byte <= place.last), None)
