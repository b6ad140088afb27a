"""Finds requests and replies of Modbus in the bytes of a line, with three kinds of framing.

A frame does not say its direction. A request to read has another length than its reply, but for
17 to 24 bits: such a reply may be the next request, and is taken for noise.
"""

from typing import NamedTuple

from gateway.errors import Garbled
from gateway.protocols.listening import Asked, DelimitedTrafficReader, Heard, Noise, Told
from gateway.protocols.modbus.ascii import body_of
from gateway.protocols.modbus.frame import (
    DIAGNOSTICS,
    EXCEPTION,
    MASK_WRITE,
    READ_BITS,
    READ_WORDS,
    REPORT_ID,
    WRITE_MANY,
    WRITE_SINGLE,
    answer_length,
)
from gateway.protocols.modbus.mbap import MbapCodec
from gateway.protocols.modbus.rtu import is_sound

_READS = (*READ_BITS, *READ_WORDS)
_READ_AND_WRITE = 23
_ECHOED = (*WRITE_SINGLE, DIAGNOSTICS, MASK_WRITE)  # the good reply is equal to the request
_MOST = {1: 2000, 2: 2000, 3: 125, 4: 125}  # units of a read

# Lengths of PDUs by function, and for the others the place of the byte that counts the rest.
_REQUESTS = {**dict.fromkeys((*_READS, *WRITE_SINGLE, DIAGNOSTICS), 5), 7: 1, 11: 1, 17: 1, 22: 7}
_COUNTED_REQUESTS = {**dict.fromkeys(WRITE_MANY, 5), _READ_AND_WRITE: 9}
_REPLIES = {**dict.fromkeys((*WRITE_SINGLE, *WRITE_MANY, DIAGNOSTICS), 5), 7: 2, 11: 5, 22: 7}
_COUNTED_REPLIES = dict.fromkeys((*_READS, REPORT_ID, _READ_AND_WRITE), 1)

_BROKEN = 0.2  # seconds; a frame without end does not wait for the next one
_FRAME_GAP = 3.5  # characters
_WRAPPING = 3  # characters around the PDU: station and CRC
_LONGEST_ASCII = 513
_MOST_OPEN = 64  # requests without a reply that are kept


class Read(NamedTuple):
    """The addresses of a read, as on the wire."""

    function: int
    wire: int
    size: int


class Meaning:
    """Tells requests from replies: a frame that fits the request before it is its reply."""

    def __init__(self) -> None:
        self._before: tuple[int, int, bytes] | None = None  # the last frame, if it was a request

    def of(self, station: int, pdu: bytes, number: int = 0) -> Heard:
        """Returns the meaning of a whole frame. `number`: of the transaction on Modbus TCP."""
        before, self._before = self._before, None
        asked = _asked(station, pdu, number)
        sent = before[2] if before is not None and before[:2] == (station, number) else None
        told = _told(station, pdu, number, sent)
        if sent is not None and told is not None:
            may_be_request = asked is not None and pdu != sent
            return Noise(pdu) if may_be_request else told
        if asked is not None:
            self._before = station, number, pdu
            return asked
        return Noise(pdu) if told is None else told


def _asked(station: int, pdu: bytes, number: int) -> Asked | None:
    function, read, size = pdu[0], None, 0
    if len(pdu) != _length(pdu, _REQUESTS, _COUNTED_REQUESTS):
        return None
    if function in _READS:
        read = Read(function, int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big"))
        if not 1 <= read.size <= _MOST[function]:
            return None
        size = answer_length(pdu)
    content = number.to_bytes(2, "big") + bytes((station,)) + pdu
    error = (number, function | EXCEPTION)
    answered = station != 0 or number != 0
    return Asked(station, content, size + 8, _shape(pdu, number), error, read, answered)


def _shape(request: bytes, number: int) -> tuple[object, ...] | None:
    """Returns the shape of the good reply; None where the request does not tell it."""
    function = request[0]
    if function in _READS:
        return number, function, answer_length(request)
    if function in _ECHOED:
        return number, request
    return (number, request[:5]) if function in WRITE_MANY else None


def _told(station: int, pdu: bytes, number: int, sent: bytes | None) -> Told | None:
    """Returns the reply to the request `sent`; without it to any. None: it is none."""
    function = pdu[0]
    if len(pdu) == 2 and function & EXCEPTION:
        if sent is None or function == sent[0] | EXCEPTION:
            return Told(station, (number, function), is_error=True)
        return None
    if len(pdu) != _length(pdu, _REPLIES, _COUNTED_REPLIES):
        return None
    shape = (number, function, len(pdu)) if function in _READS else (number, pdu)
    if sent is not None and _shape(sent, number) not in (shape, None):
        return None
    return Told(station, shape, pdu)


def _length(pdu: bytes, fixed: dict[int, int], counted: dict[int, int]) -> int | None:
    """Returns the length of a PDU with this beginning; 0: not known yet, None: none begins so."""
    function = pdu[0]
    if function in fixed:
        return fixed[function]
    if function not in counted:
        return None
    place = counted[function]
    return place + 1 + pdu[place] if len(pdu) > place else 0


class RtuTrafficReader:
    """Reads Modbus RTU. A frame begins after a silence, or right after a whole frame.

    A pause inside a frame ends nothing, because adapters cut frames: its length and CRC count.
    """

    def __init__(self, character: float) -> None:
        """`character`: seconds of one character on the wire."""
        self._gap = _FRAME_GAP * character
        self._meaning = Meaning()
        self._buffer = b""
        self._starts: list[int] = []  # places in the buffer where a frame may begin
        self._in_step = False  # the next byte begins a frame

    def feed(self, data: bytes, silence: float) -> list[Heard]:
        heard: list[Heard] = []
        if self._buffer and silence > _BROKEN:
            heard.append(Noise(self._buffer))
            self._buffer = b""
        if not self._buffer:
            self._starts = [0] if self._in_step or silence >= self._gap else []
        elif silence >= self._gap:
            self._starts.append(len(self._buffer))
        self._buffer += data
        while self._buffer:
            size = self._frame() if self._starts and self._starts[0] == 0 else None
            if size == 0:
                break
            if size is None:
                size = next((start for start in self._starts if start), len(self._buffer))
                heard.append(Noise(self._buffer[:size]))
                self._in_step = size < len(self._buffer)
            else:
                whole = self._buffer[:size]
                heard.append(self._meaning.of(whole[0], whole[1:-2]))
                self._in_step = True
            self._buffer = self._buffer[size:]
            self._starts = [0, *(start - size for start in self._starts if start > size)]
        return heard

    def _frame(self) -> int | None:
        """Returns the size of the frame at the beginning; 0: it arrives, None: there is none.

        A request goes first: a reply that is taken for one is not learned.
        """
        buffer = self._buffer
        if len(buffer) < 2:
            return 0
        pdu = buffer[1:]
        lengths = [2] if pdu[0] & EXCEPTION else []
        for tables in ((_REQUESTS, _COUNTED_REQUESTS), (_REPLIES, _COUNTED_REPLIES)):
            length = _length(pdu, *tables)
            lengths += [] if length is None else [length]
        arriving = False
        for length in lengths:
            size = length + _WRAPPING
            if not length or size > len(buffer):
                arriving = True
            elif is_sound(buffer[:size]):
                return size
        return 0 if arriving else None


def ascii_traffic_reader() -> DelimitedTrafficReader:
    """Returns a `TrafficReader` for Modbus ASCII."""
    meaning = Meaning()

    def take(data: bytes) -> tuple[Asked | Told, int] | int | None:
        size = data.find(b"\n") + 1
        if not size:
            return 0
        body = body_of(data[:size])
        heard = meaning.of(body[0], body[1:]) if body else None
        return None if heard is None or isinstance(heard, Noise) else (heard, size)

    return DelimitedTrafficReader(b":", _LONGEST_ASCII, take)


class MbapTrafficReader:
    """A `TrafficReader` for a recording of Modbus TCP: the numbers pair requests and replies."""

    def __init__(self) -> None:
        self._codec = MbapCodec()
        self._open: dict[tuple[int, int], tuple[Asked, bytes]] = {}  # by number and station

    def feed(self, data: bytes, _silence: float) -> list[Heard]:
        heard: list[Heard] = []
        try:
            frames = self._codec.feed(data)
        except Garbled:
            self._codec = MbapCodec()
            return [Noise(data)]
        for station, pdu, number in frames:
            key = number, station
            if (before := self._open.pop(key, None)) is not None:
                told = _told(station, pdu, number, before[1])
                heard += [Noise(pdu)] if told is None else [before[0], told]
            elif (asked := _asked(station, pdu, number)) is not None:
                self._open[key] = asked, pdu
                if len(self._open) > _MOST_OPEN:
                    del self._open[next(iter(self._open))]
            else:
                heard.append(Noise(pdu))
        return heard
