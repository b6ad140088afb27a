"""An FX at its programming port, written byte by byte from the public description of the protocol.

It shares nothing with the gateway: neither codec nor address map. Values are kept by name.
"""

from collections.abc import Callable

# Of the description: where the bits and words of each device begin, in bytes.
WORDS: dict[str, Callable[[int], int]] = {
    "D": lambda n: 0x0E00 + (n - 8000) * 2 if n >= 8000 else 0x1000 + n * 2,
    "T": lambda n: 0x0800 + n * 2,
    "C": lambda n: 0x0C00 + (n - 200) * 4 if n >= 200 else 0x0A00 + n * 2,
}
BITS: dict[str, Callable[[int], int]] = {
    "S": lambda n: n,
    "X": lambda n: 0x0400 + n,
    "Y": lambda n: 0x0500 + n,
    "TS": lambda n: 0x0600 + n,
    "M": lambda n: 0x0F00 + n - 8000 if n >= 8000 else 0x0800 + n,
    "CS": lambda n: 0x0E00 + n,
}


def framed(content: str) -> bytes:
    total = sum(content.encode()) + 3
    return b"\x02" + content.encode() + b"\x03" + f"{total & 255:02X}".encode()


class Peer:
    """The whole memory as bytes; `forced` are the bits that were forced."""

    def __init__(self) -> None:
        self.bytes: dict[int, int] = {}
        self.forced: list[tuple[int, bool]] = []

    def set_word(self, device: str, number: int, value: int) -> None:
        size = 4 if device == "C" and number >= 200 else 2
        for place in range(size):
            self.bytes[WORDS[device](number) + place] = value >> 8 * place & 255

    def word(self, device: str, number: int) -> int:
        size = 4 if device == "C" and number >= 200 else 2
        start = WORDS[device](number)
        return sum(self.bytes.get(start + place, 0) << 8 * place for place in range(size))

    def bit(self, device: str, number: int) -> int:
        byte, place = divmod(BITS[device](number), 8)
        return self.bytes.get(byte, 0) >> place & 1

    def set_bit(self, device: str, number: int, value: int) -> None:
        byte, place = divmod(BITS[device](number), 8)
        self.bytes[byte] = self.bytes.get(byte, 0) & ~(1 << place) | value << place

    def answer(self, request: bytes) -> list[bytes]:
        if request == b"\x05":
            return [b"\x06"]
        content = request[1:-3].decode()
        if framed(content) != request:
            return [b"\x15"]
        command, rest = content[0], content[1:]
        if command in "78":
            place = int(rest[2:4] + rest[0:2], 16)  # the low byte comes first
            byte, bit = divmod(place, 8)
            self.bytes[byte] = self.bytes.get(byte, 0) & ~(1 << bit) | (command == "7") << bit
            self.forced.append((place, command == "7"))
            return [b"\x06"]
        address, count = int(rest[0:4], 16), int(rest[4:6], 16)
        if not 1 <= count <= 64:
            return [b"\x15"]
        if command == "0":
            data = [self.bytes.get(address + place, 0) for place in range(count)]
            return [framed("".join(f"{one:02X}" for one in data))]
        digits = rest[6:]
        if len(digits) != 2 * count:
            return [b"\x15"]
        for place in range(count):
            self.bytes[address + place] = int(digits[2 * place : 2 * place + 2], 16)
        return [b"\x06"]
