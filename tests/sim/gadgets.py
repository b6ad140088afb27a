"""Simulated devices without a protocol: one replies, one sends by itself.

Their texts begin with a letter of their own, and numbers have five digits. The framing is
written a second time here, as an oracle for that of the gateway.
"""

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from gateway.stations.station import Memory

_BYTES = {"<SOH>": b"\x01", "<ETX>": b"\x03", "": b""}
_ENDINGS = {"CR LF": b"\r\n", "": b""}
REFUSED = 7  # its multiples are refused as values


@dataclass(frozen=True)
class Wrapping:
    """The header, terminator and sum around the data of a frame."""

    header: bytes = b""
    terminator: bytes = b""
    ending: bytes = b""
    summed: bool = False
    gap: float = 0.0  # seconds of silence that end a frame

    def wrap(self, body: bytes) -> bytes:
        total = b"%02X" % (sum(body + self.terminator) % 256) if self.summed else b""
        return self.header + body + self.terminator + total + self.ending

    def unwrap(self, data: bytes) -> bytes | None:
        """Returns the data of the first whole frame."""
        pattern = re.escape(self.header) + b"([ -~]*)" + re.escape(self.terminator)
        pattern += (b"([0-9A-F]{2})" if self.summed else b"()") + re.escape(self.ending)
        found = re.search(pattern, data) if self.header else re.fullmatch(pattern, data)
        if found is None:
            return None
        return found[1] if self.wrap(found[1]) == found[0] else None


def wrapping_of(framing: Any) -> Wrapping:
    """Returns the wrapping of a `framing` in the file."""
    return Wrapping(
        _BYTES[framing.header],
        _BYTES[framing.terminator],
        _ENDINGS[framing.ending],
        framing.sum_check,
        framing.gap or 0.0,
    )


@dataclass(eq=False)
class Gadget:
    """Replies to `aQ0?` and `aQ1?`, takes `aS=` with an acknowledgement and `aT=` without."""

    letter: str
    wrapping: Wrapping
    memory: Memory = field(
        default_factory=lambda: Memory(
            [("ask both", 0, 1), ("ask held", 0, 1), ("written", 0, 0), ("listened", 0, 0)]
        )
    )
    said: deque[tuple[float, float, int]] = field(default_factory=lambda: deque(maxlen=64))

    def hear(self, data: bytes, now: float) -> list[bytes]:
        body = self.wrapping.unwrap(data)
        if body is None or body[:1] != self.letter.encode():
            return []
        answer = self._answer(body[1:].decode(), now)
        return [self.wrapping.wrap(self.letter.encode() + answer)] if answer else []

    def _answer(self, text: str, now: float) -> bytes:
        match text[0:2], text[2:]:
            case "Q0", "?":
                return b"Q0=%05d,%05d" % tuple(self.memory.read("ask both", 0, 2, now))
            case "Q1", "?":
                return b"Q1=%05d,%05d" % tuple(self.memory.read("ask held", 0, 2, now))
            case "S=", digits if len(digits) == 5 and digits.isdigit():
                if int(digits) % REFUSED == 0:
                    return b"ER05"
                self.memory.write("ask held", 0, [int(digits)])
                return b"OK"
            case "T=", digits if len(digits) == 5 and digits.isdigit():
                self.memory.write("written", 0, [int(digits)])
        return b""

    def speak(self, start: float, character: float, what: int) -> bytes:
        """Returns the frame that it sends at `start` by itself: mostly its weight."""
        if what < 2:
            return self.wrapping.wrap(self.letter.encode() + (b"N", b"OL?")[what])
        (weight,) = self.memory.read("listened", 0, 1, start)
        data = self.wrapping.wrap(b"%sW=%05d" % (self.letter.encode(), weight))
        self.said.append((start, start + len(data) * character, weight))
        return data
