"""An FX at its programming port: commands 0, 1, 7 and 8, and the enquiry.

It finds devices by the list of byte addresses of the public description, independent of the driver.
"""

import re
from functools import cache

from gateway.protocols.fx.codec import ACK, ENQ, LONGEST, MOST_BYTES, NAK, STX, enclosed
from gateway.protocols.fx.driver import Fx
from gateway.stations.station import Memory, MemoryStore
from gateway.stations.store import Denied
from gateway.stations.vigor import Stretch, read_stretches, write_stretches

_STRETCHES = (
    Stretch(0x0000, 0x007C, "S", 0, 0),
    Stretch(0x0080, 0x009F, "X", 0, 0),
    Stretch(0x00A0, 0x00BF, "Y", 0, 0),
    Stretch(0x00C0, 0x00DF, "TS", 0, 0),
    Stretch(0x0100, 0x017F, "M", 0, 0),
    Stretch(0x01C0, 0x01DF, "CS", 0, 0),
    Stretch(0x01E0, 0x01FF, "M8", 8000, 0),
    Stretch(0x0800, 0x09FF, "T", 0, 2),
    Stretch(0x0A00, 0x0B8F, "C", 0, 2),
    Stretch(0x0C00, 0x0CDF, "C32", 200, 4),
    Stretch(0x0E00, 0x0FFF, "D8", 8000, 2),
    Stretch(0x1000, 0x17FF, "D", 0, 2),
)
_FRAME = re.compile(rb"\x05|\x02([^\x02\x03\x05]{0,140})\x03(..)", re.DOTALL)
_BLOCK = re.compile(rb"([01])([0-9A-F]{4})([0-9A-F]{2})((?:[0-9A-F]{2})*)\Z")
_FORCE = re.compile(rb"([78])([0-9A-F]{2})([0-9A-F]{2})\Z")


class FxStation:
    """A simulated FX. Memory areas: X Y M S T C D (octal numbers as plain integers), TS and CS the
    contacts of timers and counters, C32 the counters from C200 on, M8 and D8 the special ones."""

    def __init__(self) -> None:
        self.memory = Memory(
            (place.area, place.number, place.devices(place.last)[-1]) for place in _STRETCHES
        )
        self._store = MemoryStore(self.memory)
        self._buffer = b""

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the replies to the requests that `data` completes."""
        self._store.now = now
        self._buffer += data
        replies = []
        while match := _FRAME.search(self._buffer):
            self._buffer = self._buffer[match.end() :]
            replies.append(ACK if match[0] == ENQ else self._reply(match[0], match[1]))
        self._buffer = self._buffer[max(self._buffer.rfind(STX), 0) :][-LONGEST:]
        return replies

    def _reply(self, frame: bytes, content: bytes) -> bytes:
        try:
            if enclosed(content) == frame:
                if block := _BLOCK.match(content):
                    return self._block(block)
                if force := _FORCE.match(content):
                    self._force(force)
                    return ACK
        except Denied:
            pass
        return NAK

    def _block(self, block: re.Match[bytes]) -> bytes:
        """Raises `Denied`."""
        address, count, data = (
            int(block[2], 16),
            int(block[3], 16),
            bytes.fromhex(block[4].decode()),
        )
        places = [(_stretch(byte), byte) for byte in range(address, address + count)]
        found = [(place, byte) for place, byte in places if place is not None]
        writes = block[1] == b"1"
        if len(found) < count or not 1 <= count <= MOST_BYTES or len(data) != count * writes:
            return NAK
        if not writes:
            return enclosed(read_stretches(self._store, found).hex().upper().encode())
        write_stretches(self._store, found, data)
        return ACK

    def _force(self, force: re.Match[bytes]) -> None:
        """Raises `Denied`. The address has its low byte first."""
        byte, bit = divmod(int(force[3] + force[2], 16), 8)
        place = _stretch(byte)
        area, devices = ("", range(8)) if place is None else (place.area, place.devices(byte))
        self._store.write([((area, devices[bit] if len(devices) == 8 else -1), force[1] == b"7")])


def fx_station(_driver: Fx) -> FxStation:
    """Returns the station that the driver can talk to."""
    return FxStation()


@cache
def _stretch(byte: int) -> Stretch | None:
    return next((place for place in _STRETCHES if place.first <= byte <= place.last), None)
