"""Checks the check sum of a frame, independently of the gateway."""

import re
from collections.abc import Callable

_HEX = b"0123456789ABCDEFabcdef"


def _summed(body: bytes, digits: bytes) -> bool:
    if len(digits) != 2 or digits.strip(_HEX):
        return False
    total = 0
    for byte in body:
        total += byte
    return total % 256 == int(digits, 16)


def vigor(data: bytes) -> bool:
    """STX or ENQ, ..., ETX, two digits: the sum goes from the station to ETX."""
    return any(
        _summed(match[1], match[2])
        for match in re.finditer(rb"(?s)(?=[\x02\x05\x06\x15]+([^\x02\x05]+\x03)(..))", data)
    )


def link(data: bytes) -> bool:
    """ENQ ... sum, or STX ... ETX sum, or ACK/NAK without any sum."""
    if re.search(rb"[\x06\x15][0-9A-F]{4}", data):
        return True  # a bare acknowledgement or refusal: nothing protects it
    # An answer in which a byte became NAK, or whose text begins later, is judged from there on.
    for match in re.finditer(rb"(?s)(?=\x02([^\x02]*?\x03)(..))", data):
        if _summed(match[1], match[2]):
            return True
    return any(
        _summed(match[1], match[2])
        for match in re.finditer(rb"(?s)(?=\x05([^\x05\r]{6,}?)(..)(?:\r\n|\Z))", data)
    )


def lrc(data: bytes) -> bool:
    """Colon, hex pairs, CR LF: the sum of all pairs is zero."""
    for match in re.finditer(rb"(?=:([0-9A-Fa-f]+)\r\n)", data):
        digits = match[1]
        if len(digits) % 2 == 0 and sum(bytes.fromhex(digits.decode())) % 256 == 0:
            return True
    return False


def crc(data: bytes) -> bool:
    """Any stretch of at least four bytes that ends with its CRC, bit by bit."""
    return any(_crc_ends_well(data[first:]) for first in range(max(0, len(data) - 3)))


def _crc_ends_well(data: bytes) -> bool:
    register = 0xFFFF
    for place, byte in enumerate(data):
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ 0xA001 if register & 1 else register >> 1
        if register == 0 and place >= 3:
            return True
    return False


def frames(data: bytes) -> bool:
    """SOH, ..., ETX, two digits: the sum goes from behind SOH to ETX."""
    return any(
        _summed(match[1], match[2])
        for match in re.finditer(rb"(?s)(?=\x01([^\x01]*?\x03)(..))", data)
    )


CHECKS: dict[str, Callable[[bytes], bool]] = {
    "vigor": vigor,
    "computer-link": link,
    "modbus-ascii": lrc,
    "modbus-rtu": crc,
    "frames": frames,
}
