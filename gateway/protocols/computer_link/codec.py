"""Computer Link blocks on the wire, in formats 1 and 4, with and without sum check.

Liyan Computer Link manual 1-2 and 1-3; its lost drawings after the Mitsubishi FX
communication manual JY992D69901, chapters 7 and 8.
"""

from dataclasses import dataclass
from typing import Literal

from gateway.errors import Evidence, Garbled
from gateway.protocols.checksums import byte_sum

FrameFormat = Literal[1, 4]

STX, ETX, EOT, ENQ, ACK, CL, NAK = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0C, 0x15
CRLF = b"\r\n"

ALL_STATIONS = 0xFF  # for the global flag alone
PC = "FF"  # the PC number of every request and reply
PC_ON_DEMAND = "FE"  # the PC number of data that the PLC sends by itself

LONGEST_DATA = 256  # characters between PC number and ETX: 64 words, 256 bits, a loopback of 254

_HEX = frozenset(b"0123456789ABCDEF")
_DATA_BEHIND = "data behind ACK or NAK"
_ROUTE = 4  # station and PC number, two characters each


@dataclass(frozen=True, slots=True)
class Enquiry:
    """ENQ: a request. `wait` is the message wait in steps of 10 ms, `area` the character area."""

    station: int
    command: str
    area: str = ""
    wait: int = 0
    pc: str = PC


@dataclass(frozen=True, slots=True)
class Text:
    """STX … ETX: data from the PLC."""

    station: int
    data: str
    pc: str = PC


@dataclass(frozen=True, slots=True)
class Ack:
    station: int
    pc: str = PC


@dataclass(frozen=True, slots=True)
class Nak:
    """An error reply with its code; a NAK of the computer has no code."""

    station: int
    code: str = ""
    pc: str = PC


Frame = Enquiry | Text | Ack | Nak


class LinkCodec:
    """Bytes <-> blocks of one transaction, on the side of the computer.

    It receives STX, ACK and NAK blocks, and the echo of the last block that it encoded.
    """

    def __init__(self, frame_format: FrameFormat = 1, sum_check: bool = True) -> None:
        self._end = CRLF if frame_format == 4 else b""
        self._sum_check = sum_check
        self._buffer = bytearray()
        self._bare = False  # the last block was an answer without CR LF
        self._sent: tuple[bytes, Enquiry] | None = None

    def encode(self, frame: Frame) -> bytes:
        match frame:
            case Enquiry(station, command, area, wait, pc):
                body = f"{station:02X}{pc}{command}{wait:X}{area}".encode("ascii")
                block = bytes([ENQ]) + body + self._sum(body) + self._end
                self._sent = block, frame
                return block
            case Text(station, data, pc):
                body = f"{station:02X}{pc}{data}".encode("ascii") + bytes([ETX])
                return bytes([STX]) + body + self._sum(body) + self._end
            case Ack(station, pc):
                return bytes([ACK]) + f"{station:02X}{pc}".encode("ascii") + self._end
            case Nak(station, code, pc):
                return bytes([NAK]) + f"{station:02X}{pc}{code}".encode("ascii") + self._end

    def feed(self, data: bytes) -> list[Frame]:
        """Returns the blocks completed by `data`; skips other bytes.

        Raises `Garbled`: CHECKSUM for a wrong sum, SHAPE for a block whose end belongs to
        another setting of format or sum check, TRUNCATED for data without end. Whole blocks
        before the damage are returned first.
        """
        self._buffer += data
        frames: list[Frame] = []
        while self._buffer:
            try:
                taken = self._take()
            except Garbled:
                if frames:  # the damage stays in the buffer: the next feed raises it
                    break
                raise
            if taken == 0:
                break
            if isinstance(taken, int):
                del self._buffer[:taken]
            else:
                frames.append(taken[0])
                del self._buffer[: taken[1]]
        return frames

    def _take(self) -> int | tuple[Frame, int]:
        """Returns the first block of the buffer and its size, or the bytes to skip.

        Zero: the block is incomplete.
        """
        if self._bare and self._buffer[0] in _HEX:
            raise Garbled(_DATA_BEHIND, bytes(self._buffer), evidence=Evidence.CHECKSUM)
        self._bare = False
        match self._buffer[0]:
            case start if start == STX:
                return self._take_text()
            case start if start == ACK:
                return self._take_answer(_ROUTE)
            case start if start == NAK:
                return self._take_answer(_ROUTE + 2)
            case start if start == ENQ:
                return self._take_echo()
        return 1

    def _take_text(self) -> int | tuple[Frame, int]:
        buffer = self._buffer
        if not _HEX.issuperset(buffer[1 : 1 + _ROUTE]):
            return 1
        for etx, byte in enumerate(buffer):
            if byte == ETX:
                break
            if etx and not 0x20 <= byte < 0x7F:  # the block broke off: look for the next
                return 1
            if etx > _ROUTE + LONGEST_DATA:
                raise Garbled(
                    "a data block without end", bytes(buffer), evidence=Evidence.TRUNCATED
                )
        else:
            return 0
        size = etx + 1 + (2 if self._sum_check else 0) + len(self._end)
        if self._sum_check and not self._sum_is_right(etx):
            return 0
        if not self._ends_at(size):
            return 0
        text = buffer[1:etx].decode("ascii")
        return Text(int(text[:2], 16), text[4:], text[2:4]), size

    def _take_answer(self, length: int) -> int | tuple[Frame, int]:
        buffer = self._buffer
        if not _HEX.issuperset(buffer[1 : 1 + length]):
            return 1
        if len(buffer) < 1 + length or not self._ends_at(1 + length + len(self._end)):
            return 0
        # One wrong bit makes ACK of STX: then the data of the block follow.
        if not self._end and len(buffer) > 1 + length and buffer[1 + length] in _HEX:
            raise Garbled(_DATA_BEHIND, bytes(buffer), evidence=Evidence.CHECKSUM)
        self._bare = not self._end
        text = buffer[1 : 1 + length].decode("ascii")
        station, pc, code = int(text[:2], 16), text[2:4], text[4:]
        frame: Frame = Nak(station, code, pc) if buffer[0] == NAK else Ack(station, pc)
        return frame, 1 + length + len(self._end)

    def _take_echo(self) -> int | tuple[Frame, int]:
        if self._sent is None:
            return 1
        block, enquiry = self._sent
        if self._buffer.startswith(block):
            return enquiry, len(block)
        return 0 if block.startswith(bytes(self._buffer)) else 1

    def _sum(self, body: bytes) -> bytes:
        return byte_sum(body) if self._sum_check else b""

    def _sum_is_right(self, etx: int) -> bool:
        """False while the sum is still arriving."""
        buffer = self._buffer
        heard = bytes(buffer[etx + 1 : etx + 3])
        if CRLF.startswith(heard[:1]) and heard:
            raise self._other_setting("the PLC sends no sum check (D8120 b13)")
        if len(heard) < 2:
            return False
        if heard != byte_sum(bytes(buffer[1 : etx + 1])):
            raise Garbled("the sum check is wrong", bytes(buffer), evidence=Evidence.CHECKSUM)
        return True

    def _ends_at(self, size: int) -> bool:
        """Returns True after the CR LF of the format; False while it is arriving."""
        heard = bytes(self._buffer[size - len(self._end) : size])
        if heard == self._end:
            return True
        if self._end.startswith(heard):
            return False
        if not self._sum_check and heard[0] in _HEX and self._buffer[0] == STX:
            raise self._other_setting("the PLC sends a sum check (D8120 b13)")
        raise self._other_setting("CR LF is missing: is the PLC set to format 1 (D8120 b15)?")

    def _other_setting(self, message: str) -> Garbled:
        return Garbled(message, bytes(self._buffer), evidence=Evidence.SHAPE)
