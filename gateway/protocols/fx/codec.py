"""The frames of the FX programming port: STX, content in hex, ETX and sum; or one character.

A request names a command and an address, a reply to a read only its data. A write is acknowledged
by the single character ACK; NAK refuses a request.
"""

from binascii import unhexlify
from dataclasses import dataclass
from functools import lru_cache

from gateway.errors import Evidence, Garbled

STX, ETX, ENQ, ACK, NAK = b"\x02", b"\x03", b"\x05", b"\x06", b"\x15"
READ, WRITE, FORCE_ON, FORCE_OFF = b"0", b"1", b"7", b"8"
MOST_BYTES = 64  # of one request
AROUND = 4  # characters around the content: STX, ETX, sum
_HEX = b"0123456789ABCDEF"
LONGEST = AROUND + 7 + 2 * MOST_BYTES


@dataclass(frozen=True, slots=True)
class Request:
    """A frame to the PLC; `body` is the text between command and ETX."""

    command: bytes
    body: bytes


@dataclass(frozen=True, slots=True)
class Reply:
    """Data of a read; or `data` is None: an acknowledgement, or a refusal."""

    data: bytes | None = None
    refused: bool = False


Frame = Request | Reply


def enclosed(content: bytes) -> bytes:
    """Returns a frame; the sum runs from behind STX to ETX."""
    summed = content + ETX
    return STX + summed + b"%02X" % (sum(summed) & 0xFF)


def encode(frame: Frame) -> bytes:
    match frame:
        case Request(command, body):
            return enclosed(command + body)
        case Reply(None, refused):
            return NAK if refused else ACK
        case Reply(data):
            return enclosed((data or b"").hex().upper().encode("ascii"))


class FxCodec:
    """Bytes <-> frames on the side of the master. An echo of a request is skipped."""

    encode = staticmethod(lru_cache(maxsize=1024)(encode))

    def __init__(self) -> None:
        self._held = b""  # a frame that is still arriving
        self._noise = False  # since the last frame
        self._damage: Garbled | None = None

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the replies completed by `data`. Raises `Garbled`, after the frames before it.

        A single character behind noise is no acknowledgement: noise holds any character.
        """
        frames: list[Frame] = []
        try:
            for at in range(len(data) if self._damage is None else 0):
                character = data[at : at + 1]
                frames += self._inside(character) if self._held else self._outside(character)
        except Garbled as damage:
            self._damage = damage
        if self._damage is not None and not frames:
            raise self._damage
        return frames

    def _outside(self, character: bytes) -> list[Frame]:
        if character == STX:
            self._held = STX
        elif character not in (ACK, NAK):
            self._noise = True
        elif self._noise:
            raise Garbled("an acknowledgement behind noise", character, evidence=Evidence.NOISE)
        else:
            return [Reply(refused=character == NAK)]
        return []

    def _inside(self, character: bytes) -> list[Frame]:
        if character == STX:  # the frame before it was cut off
            self._held, self._noise = STX, True
            return []
        self._held = held = self._held + character
        place = held.find(ETX)
        if place < 0 and (character not in _HEX or len(held) > LONGEST):
            raise Garbled("a reply without an end", held, evidence=Evidence.TRUNCATED)
        if place < 0 or len(held) < place + 3:
            return []
        self._held, self._noise = b"", False
        content = held[1:place]
        if enclosed(content) != held:
            raise Garbled("a reply with a wrong sum", held, evidence=Evidence.CHECKSUM)
        # A request has an odd number of characters: it is the echo of ours.
        return [] if len(content) % 2 else [Reply(unhexlify(content))]
