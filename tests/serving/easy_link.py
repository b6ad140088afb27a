"""A master as Easy Link describes it (manual B-3-3): a table of seven registers for each transfer.

It has its own address arithmetic, from the table of the manual (B-5-3), and reads bits that share
their byte with others before it writes them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

_BASES = {3: 0x0080, 4: 0x0300, 13: 0x1C00}  # by device type: M and S are bits, D words
_BITS = (1, 2, 3, 4, 5, 6)


class Transfer(NamedTuple):
    """One row of the table."""

    station: int
    code: int  # 1: read, 2: write
    length: int
    own_type: int
    own_first: int
    its_type: int
    its_first: int


# "Read D10 ~ D19 of Slave station #5 to D0 ~ D9; write M0 ~ M29 to M100 ~ M129 of station #2."
EXAMPLE = (Transfer(5, 1, 10, 13, 0, 13, 10), Transfer(2, 2, 30, 3, 0, 3, 100))


def frame(station: int, command: str, body: str) -> bytes:
    text = f"{station:02X}{command}{body}\x03"
    return f"\x02{text}{sum(map(ord, text)) & 0xFF:02X}".encode("ascii")


class EasyLink:
    """`devices`: values of the master by device type and number. Raises `AssertionError`."""

    def __init__(self, exchange: Callable[[bytes], bytes]) -> None:
        """`exchange` sends a request and returns the reply."""
        self._exchange = exchange
        self.devices: dict[tuple[int, int], int] = {}

    def perform(self, table: Sequence[Transfer]) -> list[str]:
        """Performs every row. Returns the status of each, "00" for good."""
        return [self._write(row) if row.code == 2 else self._read(row) for row in table]

    def _read(self, row: Transfer) -> str:
        status, data = self._get(row, *self._place(row))
        for place, value in enumerate(data):
            self.devices[row.own_type, row.own_first + place] = value
        return status

    def _write(self, row: Transfer) -> str:
        values = [self.devices[row.own_type, row.own_first + i] for i in range(row.length)]
        address, size, ahead = self._place(row)
        if row.its_type not in _BITS:
            data = "".join(f"{value & 0xFF:02X}{value >> 8:02X}" for value in values)
            return self._command(row.station, "61", f"{address:04X}{size:02X}{data}")[0]
        status, text = self._command(row.station, "51", f"{address:04X}{size:02X}")
        if status != "00":
            return status
        number = int.from_bytes(bytes.fromhex(text), "little")
        for place, bit in enumerate(values):
            number = number & ~(1 << ahead + place) | bit << ahead + place
        data = number.to_bytes(size, "little").hex().upper()
        return self._command(row.station, "61", f"{address:04X}{size:02X}{data}")[0]

    def _get(self, row: Transfer, address: int, size: int, ahead: int) -> tuple[str, list[int]]:
        status, text = self._command(row.station, "51", f"{address:04X}{size:02X}")
        data = bytes.fromhex(text)
        if row.its_type in _BITS:
            bits = int.from_bytes(data, "little") >> ahead
            return status, [bits >> i & 1 for i in range(row.length)] if data else []
        return status, [data[i] | data[i + 1] << 8 for i in range(0, len(data), 2)]

    @staticmethod
    def _place(row: Transfer) -> tuple[int, int, int]:
        """Returns byte address, number of bytes, and bits before the first device."""
        base, first = _BASES[row.its_type], row.its_first
        if row.its_type in _BITS:
            return base + first // 8, (first % 8 + row.length + 7) // 8, first % 8
        return base + 2 * first, 2 * row.length, 0

    def _command(self, station: int, command: str, body: str) -> tuple[str, str]:
        """Returns status and data of the reply."""
        reply = self._exchange(frame(station, command, body)).decode("ascii")
        assert reply[0] == "\x06", reply
        assert reply[1:5] == f"{station:02X}{command}"
        assert reply[-3] == "\x03"
        assert reply[-2:] == f"{sum(map(ord, reply[1:-2])) & 0xFF:02X}"
        return reply[5:7], reply[7:-3]
