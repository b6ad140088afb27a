"""The receiving side of a simulated Computer Link PLC: finds the end of each request."""

from gateway.protocols.checksums import byte_sum
from gateway.protocols.computer_link.codec import ACK, CL, ENQ, EOT, NAK, FrameFormat
from gateway.protocols.computer_link.requests import HEADER, NEVER, area_length

_LONGEST = 600


class RequestReader:
    """Finds the requests on the line, correct or not, to any station.

    ENQ begins a request; EOT, CL, ACK and NAK cancel it. In format 4 it ends with CR LF. In
    format 1 command and count give its length; an unknown command ends where the sum is right,
    or, without sum check, with the received piece.
    """

    def __init__(self, frame_format: FrameFormat, sum_check: bool) -> None:
        self._frame_format = frame_format
        self._sum = 2 if sum_check else 0
        self._block: bytearray | None = None
        self._heard = 0.0

    @property
    def begun(self) -> int:
        """The characters of a request that is still arriving."""
        return 0 if self._block is None else 1 + len(self._block)

    def feed(self, data: bytes, now: float) -> list[str]:
        """Returns the requests completed by `data`, from station to sum."""
        self._heard = now
        requests: list[str] = []
        for byte in data:
            if byte in (ENQ, EOT, CL, ACK, NAK):
                self._block = bytearray() if byte == ENQ else None
            elif self._block is not None:
                self._block.append(byte)
                requests += self._cut(self._block)
        if self._block is not None and self._ends_with_the_piece(self._block):
            requests.append(self._block.decode("latin-1"))
            self._block = None
        return requests

    def expire(self, now: float, time_out: float) -> str:
        """Returns the beginning of a request that did not end in time, or ""."""
        block = self._block
        late = now - self._heard > time_out
        if block is None or not (late or len(block) > _LONGEST):
            return ""
        self._block = None
        return block.decode("latin-1")

    def _cut(self, block: bytearray) -> list[str]:
        if self._frame_format == 4:
            if not block.endswith(b"\r\n"):
                return []
            del block[-2:]
        elif len(block) != HEADER + area_length(block.decode("latin-1")) + self._sum:
            return []
        self._block = None
        return [block.decode("latin-1")]

    def _ends_with_the_piece(self, block: bytearray) -> bool:
        if self._frame_format == 4 or len(block) < HEADER + self._sum:
            return False
        if area_length(block.decode("latin-1")) != NEVER:
            return False
        return not self._sum or byte_sum(bytes(block[:-2])) == block[-2:]
