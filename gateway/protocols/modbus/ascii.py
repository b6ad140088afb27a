"""Modbus ASCII frames (serial line guide V1.02, 2.5.2): colon, hex digits, LRC, CR LF."""

from binascii import Error as NotHex
from binascii import unhexlify

from gateway.errors import Evidence, Garbled
from gateway.protocols.checksums import lrc
from gateway.protocols.modbus.frame import Frame, answer_length

_WRAPPING = 7  # characters around the PDU's digits: colon, station, LRC, CR LF
_LONGEST = 513


def chars(pdu_length: int) -> int:
    """Returns the characters of a frame around a PDU."""
    return 2 * pdu_length + _WRAPPING


class AsciiCodec:
    """Bytes <-> frames, on either side of the line.

    Digits are sent in upper case and received in either. A colon always begins another frame. A
    broken frame is skipped as noise, unless it has the length and the beginning of the expected
    reply: then it is `Garbled`.
    """

    def __init__(self) -> None:
        self._heard = b""
        self._head = b""  # of the reply: colon, station, function
        self._size = 0  # of the reply
        self._damage: Garbled | None = None

    def encode(self, frame: Frame) -> bytes:
        body = bytes((frame.station,)) + frame.pdu
        text = b":" + body.hex().upper().encode("ascii") + b"%02X\r\n" % lrc(body)
        self._head = text[:5]
        self._size = chars(answer_length(frame.pdu))
        return text

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the frames completed by `data`, of any station. Raises `Garbled`, after the
        frames before the damage."""
        *lines, self._heard = (self._heard + data).split(b"\n")
        self._heard = self._heard[-_LONGEST:]
        frames = []
        for line in lines:
            text = line[line.rfind(b":") :] + b"\n"
            body = body_of(text)
            if body and self._damage is None:
                frames.append(Frame(body[0], body[1:]))
            elif not body and self._is_reply(text):
                self._damage = Garbled("a reply with a wrong LRC", text, evidence=Evidence.CHECKSUM)
        if self._damage is not None and not frames:
            raise self._damage
        return frames

    def _is_reply(self, text: bytes) -> bool:
        return len(text) == self._size and text.upper().startswith(self._head)


def body_of(text: bytes) -> bytes:
    """Returns station and PDU of a frame from colon to line feed; empty for a bad frame."""
    if not text.startswith(b":") or not text.endswith(b"\r\n"):
        return b""
    try:
        octets = unhexlify(text[1:-2])
    except NotHex:
        return b""
    if len(octets) < 3 or sum(octets) & 0xFF:
        return b""
    return octets[:-1]
