"""Modbus on the wire, on the side of served stations: TCP connections, RTU and ASCII lines."""

from collections import deque

from gateway.errors import Garbled
from gateway.protocols.checksums import crc16
from gateway.protocols.modbus import AsciiCodec, Frame, MbapCodec
from gateway.protocols.modbus.frame import (
    EXCEPTION,
    READ_BITS,
    READ_WORDS,
    WRITE_MANY,
    WRITE_SINGLE,
)
from gateway.protocols.modbus.rtu import encode as rtu_encode
from gateway.stations.modbus.answers import ModbusData
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
from gateway.stations.served.echo import Sort

_WRITES = (*WRITE_SINGLE, *WRITE_MANY)
_BUSY = 6  # exception: the master repeats its request later
_NO_PATH = 0x0A  # exception: a gateway without this unit behind it
_ANY_UNIT = (0, 255)  # the device at the address itself (messaging guide V1.0b, 4.4.2.2)


class _Station:
    """One station: a request in, the PDU of its reply and the effect out."""

    def __init__(self, station: Answering) -> None:
        driver = station.driver
        self._number = driver.station
        self._data = ModbusData(
            station.registers,
            getattr(driver, "addressing", "plain"),
            low_first=getattr(driver, "counter_word_order", "low_first") == "low_first",
        )

    def answer(self, pdu: bytes) -> tuple[bytes, Done]:
        reply, refused, written = self._data.answer(pdu)
        return reply, Done(self._number, refused, pdu[0] in _WRITES, tuple(written))


class _Tcp:
    """The stations behind one TCP connection. Every request has a number: all are answered."""

    def __init__(self, stations: Stations) -> None:
        self._stations = {number: _Station(one) for number, one in stations.items()}
        if len(self._stations) == 1:
            (only,) = self._stations.values()
            self._stations |= {unit: only for unit in _ANY_UNIT if unit not in self._stations}
        self._codec = MbapCodec()
        self._waiting = deque[Frame]()

    def hear(self, data: bytes, now: float) -> Heard:
        waiting, answer, done = self._waiting, b"", tuple[Done, ...]()
        try:
            waiting += self._codec.feed(data)
        except Garbled:
            if not waiting:
                return Heard(lost=True)
        if not waiting:
            return SILENCE
        unit, pdu, number = waiting.popleft()
        if (station := self._stations.get(unit)) is not None:
            answer, did = station.answer(pdu)
            done = (did,)
        answer = answer or bytes((pdu[0] | EXCEPTION, _NO_PATH))
        return Heard(self._codec.encode(Frame(unit, answer, number)), 0.0, done, more=True)


class _Serial:
    """The stations of a serial line: answers the last request, if nothing follows it."""

    def __init__(self, stations: Stations, wire: Wire, reader: "RtuReader | AsciiReader") -> None:
        self._stations = {number: _Station(one) for number, one in stations.items()}
        self._wire = wire
        self._reader = reader

    def hear(self, data: bytes, now: float) -> Heard:
        reader, echo = self._reader, self._wire.echo
        reader.echoes = echo.pending(now)
        judged = [(one, echo.judge(reader.encode(one), now)) for one in reader.feed(data, now)]
        frames = [(one, sort) for one, sort in judged if sort is not Sort.ECHO]
        ours = [one for one, _ in frames if one.station in self._stations or one.station == 0]
        if not ours:
            return Heard(echo=bool(judged) and not frames and not reader.following)
        request, sort = frames[-1]
        # An exception is the reply of a twin, or our own: an answer to it would return.
        if request is not ours[-1] or reader.following > NOISE or request.pdu[0] & EXCEPTION:
            return Heard(stale=len(ours))
        stale = len(ours) - 1
        if request.station == 0:
            return Heard(done=self._broadcast(request.pdu), stale=stale)
        if sort is Sort.DOUBTFUL:
            answer, effects = bytes((request.pdu[0] | EXCEPTION, _BUSY)), list[Done]()
        else:
            answer, effect = self._stations[request.station].answer(request.pdu)
            effects = [effect]
        reply = reader.encode(Frame(request.station, answer))
        echo.sent(reply, now + self._wire.silence, proves=answer != request.pdu)
        return Heard(reply, self._wire.silence, tuple(effects), stale)

    def _broadcast(self, pdu: bytes) -> tuple[Done, ...]:
        """Every station carries it out where it may be written; none replies."""
        if pdu[0] not in _WRITES:
            return ()
        return tuple(station.answer(pdu)[1] for station in self._stations.values())


class AsciiReader:
    """Finds frames from colon to LF. A colon always begins another frame."""

    def __init__(self) -> None:
        self._codec = AsciiCodec()
        self.following = 0  # bytes behind the last frame
        self.echoes: list[bytes] = []  # not needed: every reply has the form of a frame

    def feed(self, data: bytes, _now: float) -> list[Frame]:
        """Returns the sound frames that `data` completes, requests and replies of any station."""
        self.following = len(data) - data.rfind(b"\n") - 1
        return self._codec.feed(data)

    @staticmethod
    def encode(frame: Frame) -> bytes:
        return AsciiCodec().encode(frame)


_SHORTEST, _LONGEST = 4, 256  # bytes of a frame
# Seconds. An adapter passes bytes on in pieces, with pauses that were not on the wire.
_ADAPTER = 0.05


class RtuReader:
    """Finds the frames of a shared wire one after another, by length and CRC.

    A frame begins where the last one ended, or after a silence. So the data of another station's
    reply is never taken for a request, whatever it holds. After bytes that are no frame it looks
    for the next silence. `NOISE` bytes between a silence and a frame are skipped.
    """

    def __init__(self, stations: Stations, wire: Wire) -> None:
        self._ours = frozenset(stations) | {0}
        self._gap = max(0.00175, 3.5 * wire.character)
        self._pause, self._usual = wire.pause(_ADAPTER), wire.usual(_ADAPTER)
        self._heard = bytearray()
        self._starts: list[int] = []  # places in `_heard` after a silence
        self._anew = 0  # the last one after a pause longer than usual
        self._skipped = NOISE  # bytes that were skipped at this place
        self._lost = False
        self._at = float("-inf")  # the time of the last bytes
        self.following = 0  # bytes behind the last frame
        self.echoes: list[bytes] = []  # of replies, which may arrive next

    def feed(self, data: bytes, now: float) -> list[Frame]:
        """Returns the sound frames that `data` completes, of any station."""
        silence, self._at = now - self._at, now
        if silence > self._pause or (self._lost and silence > self._gap):
            self._begin()
        elif silence > self._gap and self._heard:
            self._starts.append(len(self._heard))
            if silence > self._usual:
                self._anew = len(self._heard)
        if self._lost:
            return []
        if not self._heard and silence > self._gap:
            self._skipped = 0
        self._heard += data
        frames: list[Frame] = []
        while self._heard and (frame := self._take()) is not None:
            frames.append(frame)
        if not self._lost:
            self.following = len(self._heard)
        return frames

    def _begin(self) -> None:
        """Begins again after a silence."""
        self._heard.clear()
        self._starts.clear()
        self._anew = 0
        self._lost, self._skipped = False, 0

    encode = staticmethod(rtu_encode)

    def _take(self) -> Frame | None:
        """Returns the frame at the beginning; None while it is incomplete, or where none begins."""
        heard = self._heard
        while heard:
            sizes = self._sizes()
            for size in sizes:
                if _is_sound(heard, size):
                    frame = Frame(heard[0], bytes(heard[1 : size - 2]))
                    self._cut(size)
                    self._skipped = NOISE  # a frame may follow at once, noise only after a silence
                    return frame
            if len(heard) < max(sizes):
                if not self._is_again():
                    return None
                self._cut(self._anew)
            elif self._starts:
                self._cut(self._starts[0])
                self._skipped = 0
            elif self._skipped < NOISE:
                self._skipped += 1
                self._cut(1)
            else:
                self.following = len(heard)
                heard.clear()
                self._anew = 0
                self._lost = True
        return None

    def _is_again(self) -> bool:
        """Returns True when the master gave up half a request and sent it again."""
        rest = self._heard[self._anew :]
        return bool(
            self._anew
            and len(rest) >= _SHORTEST
            and rest[0] in self._ours
            and _is_sound(rest, _request_size(rest))
        )

    def _cut(self, size: int) -> None:
        del self._heard[:size]
        self._anew = max(self._anew - size, 0)
        self._starts = [start - size for start in self._starts if start > size]

    def _sizes(self) -> list[int]:
        """Returns the lengths that a frame at the beginning can have.

        Another station's number begins a request to it, or its reply. An unknown function has no
        known length: its frame may be all that arrived.
        """
        heard = self._heard
        if len(heard) < 3:
            return [_LONGEST]
        sizes = [_request_size(heard)]
        if heard[0] not in self._ours:
            sizes.append(_reply_size(heard))
        sizes += [
            len(echo) for echo in self.echoes if echo.startswith(heard) or heard.startswith(echo)
        ]
        if 0 in sizes:
            waits = heard[0] in self._ours and not self._starts
            sizes += [len(heard), _LONGEST] if waits else [len(heard)]
        return sizes


def _is_sound(heard: bytearray, size: int) -> bool:
    """Returns True when a frame of this size ends with its CRC."""
    if not _SHORTEST <= size <= len(heard):
        return False
    return crc16(bytes(heard[: size - 2])) == heard[size - 2 : size]


def _request_size(heard: bytearray) -> int:
    """Returns the length of a request; 0 for an unknown function."""
    function = heard[1]
    if function in WRITE_MANY:
        return min(9 + heard[6], _LONGEST) if len(heard) > 6 else 9
    return 8 if function in (*READ_BITS, *READ_WORDS, *WRITE_SINGLE) else 0


def _reply_size(heard: bytearray) -> int:
    """Returns the length of a reply; 0 for an unknown function."""
    function = heard[1]
    if function & EXCEPTION:
        return 5
    if function in (*WRITE_SINGLE, *WRITE_MANY):
        return 8
    if function in (*READ_BITS, *READ_WORDS):
        return min(5 + max(heard[2], 1), _LONGEST)
    return 0


def tcp(stations: Stations, _wire: Wire) -> Answerer:
    """Returns the stations behind one TCP connection."""
    return _Tcp(stations)


def rtu(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of an RTU line."""
    return _Serial(stations, wire, RtuReader(stations, wire))


def ascii_line(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of an ASCII line."""
    return _Serial(stations, wire, AsciiReader())
