"""Vigor stations of the gateway: requests 51, 61, 70 and 71 of the Computer Link (manual B-5-2).

Errors: 10 for characters and lengths, 11 for a wrong sum, 12 for an unknown command, 28 for
addresses without a tag or outside `accept`, and for a value that is not known.
"""

from gateway.protocols.checksums import byte_sum
from gateway.protocols.vigor.codec import (
    ACK,
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
from gateway.stations.served.answering import (
    NOISE,
    SILENCE,
    Answerer,
    Answering,
    Done,
    Heard,
    Stations,
    Wire,
)
from gateway.stations.served.registers import Cell, Denied, Registers, Why, Written
from gateway.stations.vigor import FORCED, Stretch, stretch

_ASCII_ERROR, _BAD_SUM, _NO_COMMAND, _OUT_OF_RANGE = "10", "11", "12", "28"
_GAP = 0.1  # seconds between two characters of a request, at most
_ANY_CASE = b"0123456789ABCDEFabcdef"


class _Refusal(Exception):
    def __init__(self, status: str) -> None:
        super().__init__(status)
        self.status = status


class _Line:
    """All stations of the wire. Replies begin with ACK, so none is taken for a request."""

    def __init__(self, stations: Stations, wire: Wire) -> None:
        self._stations = stations
        self._wire = wire
        self._reader = RequestReader()
        self._at = float("-inf")  # the time of the last bytes

    def hear(self, data: bytes, now: float) -> Heard:
        if now - self._at > _GAP:
            self._reader = RequestReader()  # half a request is no beginning of another one
        self._at = now
        requests = self._reader.feed(data)
        stations = [self._addressed(request) for request in requests]
        ours = len([station for station in stations if station is not None])
        if not ours:
            return SILENCE
        station = stations[-1]
        if station is None or self._reader.begun > NOISE:
            return Heard(stale=ours)
        status, found, written = _answer(station.registers, requests[-1])
        number, command = station.driver.station, requests[-1][3:5].upper()
        refused = "" if status == GOOD else status
        write = command in (WRITE.encode(), FORCE_ON.encode(), FORCE_OFF.encode())
        done = Done(number, refused, write, tuple(written))
        reply = encode(Reply(number, command.decode("latin-1"), status, found))
        return Heard(reply, self._wire.silence, (done,), ours - 1)

    def _addressed(self, request: bytes) -> Answering | None:
        """Returns the station of a request; None for another one, or a damaged number.

        An ACK begins the reply of another station: the request before it has lost its end.
        """
        number = request[1:3]
        if len(request) < 8 or number.strip(_ANY_CASE) or ACK in request:
            return None
        return self._stations.get(int(number, 16))


def _answer(registers: Registers, request: bytes) -> tuple[str, bytes, Written]:
    """Returns status, data and the written tags. Checks in the order of the manual's codes."""
    content, check = request[1:-3], request[-2:]
    if (content + check).translate(None, HEX_DIGITS):
        return _ASCII_ERROR, b"", ()
    if byte_sum(request[1:-2]) != check:
        return _BAD_SUM, b"", ()
    try:
        return GOOD, *_carry_out(registers, content[2:4].decode(), content[4:])
    except _Refusal as refusal:
        return refusal.status, b"", ()
    except Denied:
        return _OUT_OF_RANGE, b"", ()


def _carry_out(registers: Registers, command: str, body: bytes) -> tuple[bytes, Written]:
    """Raises `_Refusal`, `Denied`."""
    if command == READ:
        places = _places(body)
        if len(body) != 6:
            raise _Refusal(_ASCII_ERROR)
        return bytes(_byte(registers, place, byte) for place, byte in places), ()
    if command == WRITE:
        places = _places(body)
        if len(body) != 6 + 2 * len(places):
            raise _Refusal(_ASCII_ERROR)
        return b"", _write(registers, places, bytes.fromhex(body[6:].decode()))
    if command not in (FORCE_ON, FORCE_OFF):
        raise _Refusal(_NO_COMMAND)
    if len(body) != 4:
        raise _Refusal(_ASCII_ERROR)
    byte, bit = divmod(int(body, 16), 8)
    place = stretch(byte)
    if place is None or place.area not in FORCED:
        raise _Refusal(_OUT_OF_RANGE)
    return b"", registers.write(place.area, place.devices(byte)[bit], [int(command == FORCE_ON)])


def _places(body: bytes) -> list[tuple[Stretch, int]]:
    """Returns the bytes of a 51 or 61."""
    if len(body) < 6:
        raise _Refusal(_ASCII_ERROR)
    address, count = int(body[:4], 16), int(body[4:6], 16)
    if not 1 <= count <= MOST_BYTES:
        raise _Refusal(_OUT_OF_RANGE)
    places = []
    for byte in range(address, address + count):
        place = stretch(byte)
        if place is None:
            raise _Refusal(_OUT_OF_RANGE)
        places.append((place, byte))
    return places


def _byte(registers: Registers, place: Stretch, byte: int) -> int:
    devices = place.devices(byte)
    if place.width:
        return registers.read(place.area, devices[0], 1)[0] >> place.shift(byte) & 0xFF
    bits = registers.read_points(place.area, devices[0], len(devices))
    return sum(bit << i for i, bit in enumerate(bits))


def _write(registers: Registers, places: list[tuple[Stretch, int]], data: bytes) -> Written:
    """Writes all bytes as one. Raises `Denied`: also for some bytes of a register."""
    points: list[tuple[Cell, int]] = []
    words: dict[Cell, int] = {}
    sizes: dict[Cell, int] = {}
    for (place, byte), value in zip(places, data, strict=True):
        devices = place.devices(byte)
        if not place.width:
            points += [((place.area, n), value >> bit & 1) for bit, n in enumerate(devices)]
            continue
        cell = (place.area, devices[0])
        words[cell] = words.get(cell, 0) | value << place.shift(byte)
        sizes[cell] = sizes.get(cell, place.width) - 1
    if any(sizes.values()):
        raise Denied(Why.PART)
    return registers.write_points(points) if points else registers.write_cells([*words.items()])


def vigor(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of a Vigor line."""
    return _Line(stations, wire)
