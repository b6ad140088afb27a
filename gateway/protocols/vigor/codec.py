"""The frames of the Vigor computer link (manual B-5-2): STX begins a request, ACK a reply."""

import re
from binascii import unhexlify
from dataclasses import dataclass
from functools import lru_cache

from gateway.errors import Evidence, Garbled

STX, ETX, ACK = b"\x02", b"\x03", b"\x06"
HEX_DIGITS = b"0123456789ABCDEF"  # lower case is illegal on the wire

READ, WRITE, FORCE_ON, FORCE_OFF = "51", "61", "70", "71"
GOOD = "00"
MOST_BYTES = 128  # that one 51 reads or one 61 writes

SHORT_REPLY = 10  # characters of a reply without data
LONGEST_REPLY = SHORT_REPLY + 2 * MOST_BYTES
LONGEST_REQUEST = 14 + 2 * MOST_BYTES
_SHORTEST_REQUEST = 8  # station and command between STX and ETX, and the sum


@dataclass(frozen=True, slots=True)
class Request:
    """A frame to the PLC; `body` is the text between command and ETX."""

    station: int
    command: str
    body: bytes


@dataclass(frozen=True, slots=True)
class Reply:
    """A frame from the PLC; `status` is "00" when it was done, `data` the bytes read."""

    station: int
    command: str
    status: str
    data: bytes = b""


Frame = Request | Reply


def encode(frame: Frame) -> bytes:
    """Returns the bytes of the frame. The sum runs from the station to ETX.

    A station repeats a damaged command in its reply: so a command may have any character.
    """
    match frame:
        case Request(station, command, body):
            start, rest = STX, command.encode("latin-1") + body
        case Reply(station, command, status, data):
            start, rest = ACK, (command + status + data.hex().upper()).encode("latin-1")
    summed = b"%02X" % station + rest + ETX
    return start + summed + b"%02X" % (sum(summed) & 0xFF)


# ACK; station, command, status; data; then ETX and the sum, or a wrong character. An ACK without
# six digits behind it is noise; an ACK inside a frame begins another frame.
_REPLY = re.compile(
    rb"\x06([0-9A-F]{6})([0-9A-F]{0,256}+)(?:\x03([^\x06]{2})|([^\x03\x06]))", re.DOTALL
)
_REQUEST = re.compile(rb"\x02[^\x02\x03]{0,266}+\x03[^\x02]{2}", re.DOTALL)


class VigorCodec:
    """Bytes <-> frames on the side of the master: receives replies, skips other bytes.

    The result does not depend on the pieces in which the bytes arrive.
    """

    # Polls send the same requests again and again.
    encode = staticmethod(lru_cache(maxsize=1024)(encode))

    def __init__(self) -> None:
        self._buffer = b""
        self._damage: Garbled | None = None

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the replies completed by `data`.

        Raises `Garbled` for a reply that is damaged after its header. Whole replies before the
        damage are returned first.
        """
        self._buffer += data
        frames: list[Frame] = []
        while self._damage is None and (match := _REPLY.search(self._buffer)):
            self._buffer = self._buffer[match.end() :]
            try:
                frames.append(_reply(match))
            except Garbled as damage:
                self._damage = damage
        if self._damage is not None and not frames:
            raise self._damage
        self._buffer = _unfinished(self._buffer, ACK, LONGEST_REPLY)
        return frames


def _reply(match: re.Match[bytes]) -> Reply:
    head, digits, check, stray = match.groups()
    whole = match[0]
    if stray is not None and len(digits) == 2 * MOST_BYTES:
        raise Garbled("a reply without an end", whole, evidence=Evidence.TRUNCATED)
    if stray is not None:
        raise Garbled("no hexadecimal digit in the data of a reply", whole)
    if b"%02X" % (sum(whole[1:-2]) & 0xFF) != check:
        raise Garbled("a reply with a wrong sum", whole, evidence=Evidence.CHECKSUM)
    if len(digits) % 2:
        raise Garbled("a reply with half a byte of data", whole, evidence=Evidence.SHAPE)
    names = head.decode("ascii")
    return Reply(int(names[:2], 16), names[2:4], names[4:], unhexlify(digits))


def first_reply(data: bytes) -> tuple[Reply | None, int]:
    """Returns the reply at the beginning of the bytes and its size; None: not whole yet.

    Raises `Garbled`.
    """
    match = _REPLY.match(data)
    return (None, 0) if match is None else (_reply(match), match.end())


def first_request(data: bytes) -> tuple[bytes | None, int]:
    """As `first_reply`, for a request: its bytes."""
    match = _REQUEST.match(data)
    if match is None:
        return None, 0
    whole = match[0]
    if len(whole) < _SHORTEST_REQUEST or not frozenset(HEX_DIGITS).issuperset(whole[1:3]):
        raise Garbled("no request", whole, evidence=Evidence.SHAPE)
    if b"%02X" % (sum(whole[1:-2]) & 0xFF) != whole[-2:]:
        raise Garbled("a request with a wrong sum", whole, evidence=Evidence.CHECKSUM)
    return whole, len(whole)


class RequestReader:
    """The side of the PLC: finds requests, correct or not, from STX to the sum."""

    def __init__(self) -> None:
        self._buffer = b""

    @property
    def begun(self) -> int:
        """The bytes of a request that is still arriving."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Returns the requests completed by `data`. A new STX begins another request."""
        self._buffer += data
        requests = []
        while match := _REQUEST.search(self._buffer):
            requests.append(match[0])
            self._buffer = self._buffer[match.end() :]
        self._buffer = _unfinished(self._buffer, STX, LONGEST_REQUEST)
        return requests


def _unfinished(buffer: bytes, start: bytes, longest: int) -> bytes:
    """Returns the part of the buffer that may still become a frame."""
    begin = buffer.rfind(start)
    return buffer[begin:] if 0 <= begin > len(buffer) - longest else b""
