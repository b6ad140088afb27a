"""Check sums, under the names the manuals give them."""

from array import array
from functools import lru_cache
from struct import unpack_from


def byte_sum(data: bytes) -> bytes:
    """The sum of all bytes, its low byte as two hex characters (Vigor, Computer Link)."""
    return b"%02X" % (sum(data) & 0xFF)


def lrc(data: bytes) -> int:
    """Modbus ASCII: the two's complement of the low byte of the sum."""
    return -sum(data) & 0xFF


def _crc_table() -> "array[int]":
    """Returns the remainder after two bytes, for each remainder: the sum of those of its bits."""
    table = array("H", [0])
    for bit in range(16):
        crc = 1 << bit
        for _ in range(16):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
        table.extend([other ^ crc for other in table])
    return table


_CRC = _crc_table()


@lru_cache(maxsize=256)  # requests and replies often repeat
def crc16(data: bytes) -> bytes:
    """Modbus RTU: CRC-16, initial value FFFFh, polynomial A001h reflected; low byte first."""
    crc = 0xFFFF
    pairs, odd = divmod(len(data), 2)
    for pair in unpack_from(f"<{pairs}H", data):
        crc = _CRC[crc ^ pair]
    if odd:
        crc = (crc >> 8) ^ _CRC[((crc ^ data[-1]) & 0xFF) << 8]
    return crc.to_bytes(2, "little")
