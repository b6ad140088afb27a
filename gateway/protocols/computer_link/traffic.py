"""Finds requests and replies of the Computer Link in the bytes of a line."""

import re
from typing import NamedTuple

from gateway.errors import ConfigError
from gateway.protocols.checksums import byte_sum
from gateway.protocols.computer_link.access import SIXTEEN, Access
from gateway.protocols.computer_link.codec import (
    ACK,
    ALL_STATIONS,
    CRLF,
    ENQ,
    NAK,
    PC_ON_DEMAND,
    STX,
    FrameFormat,
)
from gateway.protocols.computer_link.devices import Profile, wire_name
from gateway.protocols.computer_link.requests import HEADER, NEVER, area_length
from gateway.protocols.devices import parse_device
from gateway.protocols.driver import Span, Unit
from gateway.protocols.listening import Asked, DelimitedTrafficReader, Learn, Told

_LONGEST = 600
_PIECES = {"BR": (1, 1), "WR": (4, 8)}  # characters of a point; of a word and of a dword
_ERROR = "error"  # the shape of an error reply
_ACKNOWLEDGED = ("ack", 0)
_FRAMES = {
    STX: re.compile(rb"\x02([0-9A-F]{4})([\x20-\x7e]*)\x03"),
    ACK: re.compile(rb"\x06([0-9A-F]{4})"),
    NAK: re.compile(rb"\x15([0-9A-F]{4})([0-9A-F]{2})"),
}
_REQUEST_4 = re.compile(rb"\x05[\x20-\x7e]*\r\n")
_COUNT = re.compile(r"[0-9A-F]{2}")
_STATION = re.compile(rb"[0-9A-F]{4}")


class Read(NamedTuple):
    """A read of devices as on the wire: `D0100`, ten pieces."""

    command: str
    device: str
    pieces: int


class LinkTrafficReader:
    """Takes the frames at the beginning of the bytes."""

    def __init__(self, frame_format: FrameFormat, sum_check: bool) -> None:
        self._end = CRLF if frame_format == 4 else b""
        self._sum = 2 if sum_check else 0
        self._confirmed: int | None = None  # the station whose data the master may confirm

    def take(self, data: bytes) -> tuple[Asked | Told | None, int] | int | None:
        """As `delimited.Take`. Skips the acknowledgement of data by the master (area C)."""
        if data[0] == ENQ:
            return self._request(data)
        match = _FRAMES[data[0]].match(data)
        if match is None:
            return 0
        checked = self._sum if data[0] == STX else 0
        size = match.end() + checked + len(self._end)
        if len(data) < size:
            return 0
        body, rest = data[1 : match.end()], data[match.end() : size]
        if rest != (byte_sum(body) if checked else b"") + self._end:
            return None
        station, pc = int(match[1][:2], 16), match[1][2:].decode("ascii")
        if pc == PC_ON_DEMAND:
            return None  # sent without a request
        confirmed, self._confirmed = self._confirmed, None
        match data[0]:
            case start if start == STX:
                text = match[2].decode("ascii")
                self._confirmed = station
                return Told(station, ("text", len(text)), text), size
            case start if start == NAK:
                return Told(station, _ERROR, is_error=True), size
        acknowledged = None if confirmed == station else Told(station, _ACKNOWLEDGED)
        return acknowledged, size

    def _request(self, data: bytes) -> tuple[Asked, int] | int | None:
        self._confirmed = None
        if self._end:
            match = _REQUEST_4.match(data)
            if match is None:
                return 0
            size = match.end()
        else:
            length = area_length(data[1:].decode("latin-1"))
            if length == NEVER:
                return None
            size = 1 + HEADER + length + self._sum
            if len(data) < size:
                return 0
        whole = data[:size]
        end = size - len(self._end) - self._sum
        body = whole[1:end]
        if len(body) < HEADER or not _STATION.match(body):
            return None
        if whole[end : end + self._sum] != byte_sum(body)[: self._sum]:
            return None
        return _asked(whole, body.decode("latin-1")), size


def _asked(whole: bytes, body: str) -> Asked:
    station, command, area = int(body[:2], 16), body[4:6], body[HEADER:]
    read: Read | None = None
    shape: tuple[str, int] | None = None
    match command:
        case "BR" | "WR" if _COUNT.fullmatch(area[5:]):
            read = Read(command, area[:5], int(area[5:], 16) or 256)
            shape = ("text", read.pieces * _digits(read))
        case "TT":
            shape = ("text", len(area))
        case "BW" | "WW" | "BT" | "WT" | "BM" | "WM" | "RR" | "RS":
            shape = _ACKNOWLEDGED
    size = 16 + (shape[1] if shape else 0)
    answered = station != ALL_STATIONS
    return Asked(station, whole, size, shape, _ERROR, read, answered)


def _digits(read: Read) -> int:
    word, dword = _PIECES[read.command][0], _PIECES[read.command][-1]
    return dword if "CN200" <= read.device <= "CN255" and read.command == "WR" else word


def link_traffic_reader(frame_format: FrameFormat, sum_check: bool) -> DelimitedTrafficReader:
    take = LinkTrafficReader(frame_format, sum_check).take
    return DelimitedTrafficReader(bytes((ENQ, STX, ACK, NAK)), _LONGEST, take)


def learn(read: Read, profile: Profile, span: Span) -> Learn | None:
    """Returns the decoder of the span; None if the read does not hold all of it."""
    try:
        head = parse_device(read.device, profile.table)
    except ConfigError:
        return None
    area, in_words = profile.areas[head.area], read.command == "WR"
    of_bits = area.unit is Unit.BIT
    if area.name != span.area or wire_name(area, head.number) != read.device:
        return None
    if not in_words and not of_bits:
        return None
    step = SIXTEEN if in_words and of_bits else 1
    whole = Span(area.name, head.number, read.pieces * step)
    first = span.start - whole.start
    if first < 0 or first + span.size > whole.size or whole.start + whole.size > area.last + 1:
        return None
    access = Access(whole, area, in_words, head.number, step, read.pieces, _digits(read))

    def decode(data: str) -> list[int] | None:
        units = access.decode(data)
        return None if units is None else units[first : first + span.size]

    return decode
