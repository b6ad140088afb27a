"""Computer Link stations of the gateway, formats 1 and 4 (Liyan manual, chapter 2).

Served are BR, WR, BW, WW, BT, WT and the loopback TT. Errors (NAK): 02 for a wrong sum, 03 for an
unknown command, 06 for addresses without a tag or outside `accept`, for a value that is not known
and for commands that are not served, 07 for wrong data, 10 for another PC number, 18 for run and
stop. A global (GW, station FF) has no reply and no effect.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from gateway.protocols.checksums import byte_sum
from gateway.protocols.computer_link.codec import (
    ALL_STATIONS,
    PC,
    Ack,
    Frame,
    FrameFormat,
    LinkCodec,
    Nak,
    Text,
)
from gateway.stations.computer_link.devices import Cells, Kind, Limits, No, limits, locate
from gateway.stations.computer_link.requests import RequestReader
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
from gateway.stations.served.registers import Cell, Denied, Registers, Written

_TIME_OUT = 0.1  # seconds between two characters of a request, at most (D8129)
_BATCH = ("BR", "WR", "BW", "WW")
_ENTRY = {"BT": 6, "WT": 9}  # characters of a device and its data
_NOT_SERVED = ("BM", "WM", "MB", "MN", "MW", "PC")
_REMOTE = ("RR", "RS")
_GLOBAL, _LOOPBACK = "GW", "TT"
_COMMANDS = (*_BATCH, *_ENTRY, *_NOT_SERVED, *_REMOTE, _GLOBAL, _LOOPBACK)
_WRITES = ("BW", "WW", *_ENTRY)
_HEX = frozenset("0123456789ABCDEF")
_STEP = 0.01  # seconds of the message wait


class _Request(NamedTuple):
    """A request without station and sum."""

    pc: str
    command: str
    wait: str
    area: str


class _Line:
    """All stations of the wire. Replies begin with STX, ACK or NAK: none is taken for a request."""

    def __init__(self, stations: Stations, wire: Wire) -> None:
        self._stations = stations
        self._wire = wire
        driver = next(iter(stations.values())).driver
        self._frame_format: FrameFormat = getattr(driver, "frame_format", 1)
        self._sum_check: bool = getattr(driver, "sum_check", True)
        self._reader = RequestReader(self._frame_format, self._sum_check)

    def hear(self, data: bytes, now: float) -> Heard:
        self._reader.expire(now, _TIME_OUT)
        texts = self._reader.feed(data, now)
        stations = [self._addressed(text) for text in texts]
        ours = len([station for station in stations if station is not None])
        if not ours:
            return SILENCE
        station = stations[-1]
        if station is None or self._reader.begun > NOISE:
            return Heard(stale=ours)
        return self._answer(station, texts[-1])._replace(stale=ours - 1)

    def _addressed(self, text: str) -> Answering | None:
        """Returns the station of a request; None for another one, and for all of them."""
        number = text[:2]
        if len(number) < 2 or not _HEX.issuperset(number) or int(number, 16) == ALL_STATIONS:
            return None
        return self._stations.get(int(number, 16))

    def _answer(self, station: Answering, text: str) -> Heard:
        number, wait = station.driver.station, 0.0
        done = Done(number)
        reply: Frame | None
        try:
            request = self._checked(text)
            wait = int(request.wait, 16) * _STEP
            if request.command == _GLOBAL:
                return SILENCE
            reply, written = _carry_out(station, request)
            done = Done(number, "", request.command in _WRITES, tuple(written))
        except No as refusal:
            reply, done = Nak(number, refusal.code), Done(number, refusal.code)
        except Denied:
            reply, done = Nak(number, "06"), Done(number, "06")
        frame = LinkCodec(self._frame_format, self._sum_check).encode(reply)
        return Heard(frame, max(wait, self._wire.silence), (done,))

    def _checked(self, text: str) -> _Request:
        """Raises `No` 02, 03, 06."""
        if self._sum_check:
            if byte_sum(text[:-2].encode("latin-1")).decode() != text[-2:]:
                raise No("02")
            text = text[:-2]
        request = _Request(text[2:4], text[4:6], text[6:7], text[7:])
        if request.command not in _COMMANDS:
            raise No("03")
        if not request.wait or request.wait not in _HEX:
            raise No("06")
        return request


def _carry_out(station: Answering, request: _Request) -> tuple[Frame, Written]:
    """Raises `No` in the order of the codes, and `Denied`."""
    number, command, area = station.driver.station, request.command, request.area
    most = limits(getattr(station.driver, "profile", "liyan"))
    if command in _NOT_SERVED or (command in _REMOTE and area):
        raise No("06")
    if command == _LOOPBACK:
        if not 1 <= _hex(area[:2]) <= most.loopback or len(area) != 2 + _hex(area[:2]):
            raise No("06")
        parts: list[tuple[Cells, Sequence[int]]] = []
    elif command in _REMOTE:
        parts = []
    else:
        read_area = _batch if command in _BATCH else _list
        parts = list(read_area(command, area, most))
    if request.pc != PC:
        raise No("10")
    if command in _REMOTE:
        raise No("18")
    if command == _LOOPBACK:
        return Text(number, area), ()
    if command in _WRITES:
        return Ack(number), _write(station.registers, parts)
    return Text(number, "".join(_read(station.registers, cells) for cells, _ in parts)), ()


def _batch(command: str, area: str, most: Limits) -> Iterator[tuple[Cells, Sequence[int]]]:
    """Yields the devices of a BR, WR, BW or WW, with the units to write. Raises `No`."""
    words, writes = command[0] == "W", command[1] == "W"
    count = _hex(area[5:7])
    if count == 0 and command == "BR" and most.read[Kind.BITS] == 256:
        count = 256
    cells = locate(area[:5], words, count)
    if not 1 <= count <= (most.write if writes else most.read)[cells.kind]:
        raise No("06")
    if len(area) != 7 + (cells.characters if writes else 0):
        raise No("06")
    yield cells, cells.decode(area[7:]) if writes else ()


def _list(command: str, area: str, most: Limits) -> Iterator[tuple[Cells, Sequence[int]]]:
    """Yields the devices of a BT or WT with their units. Raises `No`."""
    words, size = command[0] == "W", _ENTRY[command]
    count = _hex(area[:2])
    allowed = most.scattered_words if words else most.scattered_bits
    if not 1 <= count <= allowed or len(area) != 2 + count * size:
        raise No("06")
    entries = [area[at : at + size] for at in range(2, len(area), size)]
    places = [locate(entry[:5], words, 1) for entry in entries]
    if any(cells.kind is Kind.DWORDS for cells in places):
        raise No("06")
    for cells, entry in zip(places, entries, strict=True):
        yield cells, cells.decode(entry[5:])


def _read(registers: Registers, cells: Cells) -> str:
    if cells.kind is not Kind.SIXTEENS:
        return cells.encode(registers.read(cells.area, cells.first, cells.size))
    units: list[int] = []
    for first in range(cells.first, cells.first + cells.size, 16):
        units += registers.read_points(cells.area, first, 16)
    return cells.encode(units)


def _write(registers: Registers, parts: Sequence[tuple[Cells, Sequence[int]]]) -> Written:
    """Writes all parts as one. Raises `Denied`."""
    points: list[tuple[Cell, int]] = []
    others: list[tuple[Cell, int]] = []
    for cells, units in parts:
        pairs = zip(cells, units, strict=True)
        (points if cells.kind is Kind.SIXTEENS else others).extend(pairs)
    return registers.write_points(points, others) if points else registers.write_cells(others)


def _hex(text: str) -> int:
    if len(text) != 2 or not _HEX.issuperset(text):
        raise No("06")
    return int(text, 16)


def computer_link(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of a Computer Link line."""
    return _Line(stations, wire)
