"""A talk in which something certain is heard, whatever is asked; and pymodbus' view of frames."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from pymodbus.framer import FramerAscii, FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from gateway.errors import NoReply
from gateway.protocols.modbus import Frame, ModbusAscii, ModbusRtu, ModbusTcp

T = TypeVar("T")
KINDS = (ModbusRtu, ModbusAscii, ModbusTcp)
Driver = ModbusRtu | ModbusAscii | ModbusTcp
FRAMERS: dict[type, type[FramerBase]] = {
    ModbusRtu: FramerRTU,
    ModbusAscii: FramerAscii,
    ModbusTcp: FramerSocket,
}


class Hearing:
    """A `Talk`: to the n-th question, the n-th item of `heard` is what comes back, piece by piece.

    An item may also be what makes the pieces of the question's bytes.
    """

    may_echo = False

    def __init__(
        self, driver: Driver, *heard: Sequence[bytes] | Callable[[bytes], Sequence[bytes]]
    ) -> None:
        self._codec = driver.codec()
        self._heard = list(heard)
        self.sent: list[bytes] = []
        self.replies: list[int] = []

    async def tell(self, frame: Frame) -> None:
        self.sent.append(self._codec.encode(frame))

    async def ask(self, frame: Frame, reply: int, answers: Callable[[Frame], T | None]) -> T:
        await self.tell(frame)
        self.replies.append(reply)
        pieces = self._heard.pop(0) if self._heard else []
        if callable(pieces):
            pieces = pieces(self.sent[-1])
        for piece in pieces:
            for got in self._codec.feed(piece):
                answer = answers(got)
                if answer is not None:
                    return answer
        raise NoReply("no answer")


def oracle_decodes(kind: type, data: bytes, station: int, *, requests: bool) -> ModbusPDU:
    """What pymodbus reads out of one frame."""
    used, pdu = FRAMERS[kind](DecodePDU(requests)).handleFrame(data, station, 0)
    assert used == len(data)
    assert pdu is not None
    return pdu


def oracle_encodes(kind: type, pdu: ModbusPDU) -> bytes:
    return FRAMERS[kind](DecodePDU(True)).buildFrame(pdu)
