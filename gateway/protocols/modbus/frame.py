"""A Modbus frame without framing: station and PDU (function code and data)."""

from typing import NamedTuple


class Frame(NamedTuple):
    """One request or reply. `transaction` is its number on Modbus TCP, and 0 elsewhere."""

    station: int
    pdu: bytes
    transaction: int = 0


READ_BITS = (1, 2)
READ_WORDS = (3, 4)
WRITE_SINGLE = (5, 6)
WRITE_MANY = (15, 16)
DIAGNOSTICS = 8
MASK_WRITE = 22
REPORT_ID, READ_IDENTITY = 17, 43
EXCEPTION = 0x80  # added to the function code of the request


def answer_length(request: bytes) -> int:
    """Returns the length of the PDU that replies to `request`, without an exception."""
    function = request[0]
    count = int.from_bytes(request[3:5], "big")
    if function in READ_BITS:
        return 2 + (count + 7) // 8
    if function in READ_WORDS:
        return 2 + 2 * count
    return 7 if function == MASK_WRITE else 5
