"""Modbus RTU frames (serial line guide V1.02, 2.5.1), found by header, length and CRC.

Not by silence: USB adapters and device servers split and join the bytes, so silence cannot be
seen behind them. The length of a frame follows from its function code and byte count.
"""

from gateway.errors import Evidence, Garbled
from gateway.protocols.checksums import crc16
from gateway.protocols.modbus.frame import (
    DIAGNOSTICS,
    EXCEPTION,
    MASK_WRITE,
    READ_BITS,
    READ_IDENTITY,
    READ_WORDS,
    REPORT_ID,
    WRITE_MANY,
    WRITE_SINGLE,
    Frame,
    answer_length,
)

_WRAPPING = 3  # characters around the PDU: station and CRC
_SHORTEST = 5  # an exception
_LONGEST = 256
_KEPT = 520  # no frame is longer than 260; bytes before the last two frames are noise
_FIXED = (*WRITE_SINGLE, *WRITE_MANY, DIAGNOSTICS)
_ECHOED = (*WRITE_SINGLE, DIAGNOSTICS, MASK_WRITE)  # the good reply is equal to the request
_KNOWN = (*READ_BITS, *READ_WORDS, *_FIXED, MASK_WRITE)
_REPLIED = (*_KNOWN, REPORT_ID, READ_IDENTITY)  # by a device that has them


def chars(pdu_length: int) -> int:
    """Returns the characters of a frame around a PDU."""
    return pdu_length + _WRAPPING


def encode(frame: Frame) -> bytes:
    body = bytes((frame.station,)) + frame.pdu
    return body + crc16(body)


class RtuCodec:
    """Bytes <-> frames on the side of the master.

    It remembers the request, which decides what can be the reply: it waits for the rest of a
    possible reply; all else is noise until its CRC is right. An echo of the request is noise as
    well, except for functions 05, 06 and 08, where the reply is equal to the request: only the
    line knows whether it echoes.
    """

    def __init__(self) -> None:
        self._heard = bytearray()
        self._sent = b""
        self._size = 0  # of the whole reply, unless it is an exception
        self._damage: Garbled | None = None
        self._noise = 0  # bytes at the begin of `_heard` where no reply can begin

    def encode(self, frame: Frame) -> bytes:
        self._sent = encode(frame)
        self._size = chars(answer_length(frame.pdu))
        return self._sent

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the frames completed by `data`, of any station.

        Raises `Garbled` when a certain reply has a wrong CRC. Whole frames before it are
        returned first.
        """
        if not self._heard and _whole_reply(data):
            return [Frame(data[0], data[1:-2])]  # the usual case
        self._heard += data
        frames: list[Frame] = []
        while self._damage is None and (frame := self._take()) is not None:
            frames.append(frame)
        if self._damage is not None and not frames:
            raise self._damage
        return frames

    def _take(self) -> Frame | None:
        heard = self._heard
        if (much := len(heard) - _KEPT) > 0:
            del heard[:much]
            self._noise = max(0, self._noise - much)
        for start in range(self._noise, len(heard) - _SHORTEST + 1):
            size = _reply_size(heard, start)
            if size == 0:
                self._noise += start == self._noise
                continue
            whole = bytes(heard[start : start + size])
            if len(whole) == size and is_sound(whole):
                del heard[: start + size]
                self._noise = 0
                return Frame(whole[0], whole[1:-2])
            if whole[:2] != self._sent[:2] or self._may_be_echo(heard[start:]):
                continue
            if len(whole) < size:
                return None  # the reply, still arriving
            if size == self._size:
                self._damage = Garbled(
                    "a reply with a wrong CRC", whole, evidence=Evidence.CHECKSUM
                )
                return None
        return None

    def _may_be_echo(self, heard: bytearray) -> bool:
        """True when the received bytes are equal to the request so far."""
        sent = self._sent
        return sent[1] not in _ECHOED and sent.startswith(heard[: len(sent)])


def is_sound(whole: bytes) -> bool:
    """Returns True when a frame ends with its CRC."""
    return crc16(whole[:-2]) == whole[-2:]


def _whole_reply(data: bytes) -> bool:
    """Returns True for exactly one whole reply."""
    return len(data) >= _SHORTEST and _reply_size(data, 0) == len(data) and is_sound(data)


def _reply_size(heard: bytes | bytearray, start: int) -> int:
    """Returns the length of a reply that begins at `start`; 0 where no reply can begin."""
    function, third = heard[start + 1], heard[start + 2]
    if function in _FIXED:
        return 8
    if function == MASK_WRITE:
        return 10
    if function in READ_WORDS:
        return 5 + third if third and third % 2 == 0 else 0
    if function in (*READ_BITS, REPORT_ID):
        return 5 + third if third else 0
    if function == READ_IDENTITY:
        return _identity_size(heard[start : start + _LONGEST])
    return _SHORTEST if function & EXCEPTION and function - EXCEPTION in _REPLIED else 0


def _identity_size(heard: bytes | bytearray) -> int:
    """Returns the length of a reply to function 43, or, while it is not known, a lower limit."""
    size = 8  # station, function, MEI type, level, conformity, more, next object, their number
    for _ in range(heard[7] if len(heard) > 7 else 0):
        size += 2 + (heard[size + 1] if len(heard) > size + 1 else 0)
    return size + 2


class RtuSlaveCodec:
    """Bytes <-> frames on the side of a slave.

    It waits for the rest of a request to this station or to all; after a silence the caller
    makes a new codec. An unknown function has no known length: it is a request when all
    received bytes end with its CRC.
    """

    def __init__(self, station: int) -> None:
        self._heard = bytearray()
        self._addressed = (0, station)

    encode = staticmethod(encode)

    def feed(self, data: bytes) -> list[Frame]:
        self._heard += data
        frames: list[Frame] = []
        while (frame := self._take()) is not None:
            frames.append(frame)
        return frames

    def _take(self) -> Frame | None:
        heard = self._heard
        del heard[:-_KEPT]
        for start in range(len(heard) - 7):
            size = _request_size(heard, start)
            if size == 0:
                continue
            whole = bytes(heard[start : start + size])
            if len(whole) < size and whole[0] in self._addressed:
                return None
            if len(whole) == size and is_sound(whole):
                del heard[: start + size]
                self._noise = 0
                return Frame(whole[0], whole[1:-2])
        return self._unknown()

    def _unknown(self) -> Frame | None:
        whole = bytes(self._heard)
        if (
            len(whole) < 4
            or whole[0] not in self._addressed
            or whole[1] in _KNOWN
            or not is_sound(whole)
        ):
            return None
        self._heard.clear()
        return Frame(whole[0], whole[1:-2])


def _request_size(heard: bytearray, start: int) -> int:
    """Returns the length of a request that begins at `start`; 0 where no request can begin."""
    function = heard[start + 1]
    if function in WRITE_MANY:
        return 9 + heard[start + 6]
    if function == MASK_WRITE:
        return 10
    return 8 if function in _KNOWN else 0
