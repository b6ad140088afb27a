"""Check sums, under the names the manuals give them."""

from collections.abc import Iterable


def byte_sum(data: bytes) -> bytes:
    """The sum of all bytes, its low byte as two hex characters (Vigor, Computer Link)."""
    return b"%02X" % (sum(data) & 0xFF)


def lrc(data: bytes) -> int:
    """Modbus ASCII: the two's complement of the low byte of the sum."""
    return -sum(data) & 0xFF


def _crc_table() -> Iterable[int]:
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
        yield crc


_CRC = tuple(_crc_table())


def crc16(data: bytes) -> bytes:
    """Modbus RTU: CRC-16, initial value FFFFh, polynomial A001h reflected; low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _CRC[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")
