"""Modbus TCP frames (messaging guide V1.0b, 3.1): the MBAP header numbers each request."""

from struct import Struct

from gateway.errors import Evidence, Garbled
from gateway.protocols.modbus.frame import Frame

_HEADER = Struct(">HHHB")  # transaction, protocol (0), length from here on, unit
_SIZE, _header_of = _HEADER.size, _HEADER.unpack_from
_UNIT_AND_PDU = range(2, 255)


def chars(pdu_length: int) -> int:
    """Returns the bytes of a frame around a PDU."""
    return pdu_length + _SIZE


class MbapCodec:
    """Bytes <-> frames, on either side of the connection.

    TCP neither loses nor adds bytes: bytes that are no frame show that the other side is no
    Modbus TCP device, or permanently out of step.
    """

    def __init__(self) -> None:
        self._heard = b""

    def encode(self, frame: Frame) -> bytes:
        header = _HEADER.pack(frame.transaction, 0, len(frame.pdu) + 1, frame.station)
        return header + frame.pdu

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the frames completed by `data`. Raises `Garbled`, after the frames before it."""
        heard = self._heard + data if self._heard else data
        frames: list[Frame] = []
        while len(heard) >= _SIZE:
            transaction, protocol, length, unit = _header_of(heard)
            if protocol or length not in _UNIT_AND_PDU:
                if frames:
                    break
                raise Garbled("not a Modbus TCP header", heard, evidence=Evidence.NOISE)
            end = length + 6
            if len(heard) < end:
                break
            frames.append(Frame(unit, heard[_SIZE:end], transaction))
            heard = heard[end:]
        self._heard = heard
        return frames
