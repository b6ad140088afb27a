"""A Modbus frame without its wrapping: who is spoken to, and the PDU (function code and data)."""

from typing import NamedTuple


class Frame(NamedTuple):
    """One question or answer. `transaction` numbers it on Modbus TCP and is 0 elsewhere."""

    station: int
    pdu: bytes
    transaction: int = 0


READ_BITS = (1, 2)
READ_WORDS = (3, 4)
WRITE_SINGLE = (5, 6)
WRITE_MANY = (15, 16)
DIAGNOSTICS = 8
EXCEPTION = 0x80  # added to the function code of the question


def answer_length(request: bytes) -> int:
    """The bytes of the PDU that answers `request`, when the answer is not an exception."""
    function = request[0]
    count = int.from_bytes(request[3:5], "big")
    if function in READ_BITS:
        return 2 + (count + 7) // 8
    if function in READ_WORDS:
        return 2 + 2 * count
    return 5
