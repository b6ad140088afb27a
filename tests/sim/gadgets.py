"""Simulated devices without a protocol: one that is asked, one that speaks by itself.

What they say begins with a letter of their own, and numbers have five digits. Their framing is
written a second time here, to judge the gateway's by.
"""

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from gateway.stations.station import Memory

_BYTES = {"<SOH>": b"\x01", "<ETX>": b"\x03", "": b""}
_ENDINGS = {"CR LF": b"\r\n", "": b""}
REFUSED = 7  # values that are multiples of it are not taken


@dataclass(frozen=True)
class Wrapping:
    """The bytes around the data of a frame."""

    header: bytes = b""
    terminator: bytes = b""
    ending: bytes = b""
    summed: bool = False
    gap: float = 0.0  # seconds of silence that end a frame

    def wrap(self, body: bytes) -> bytes:
        total = b"%02X" % (sum(body + self.terminator) % 256) if self.summed else b""
        return self.header + body + self.terminator + total + self.ending

    def unwrap(self, data: bytes) -> bytes | None:
        """The data of the first whole frame in it."""
        pattern = re.escape(self.header) + b"([ -~]*)" + re.escape(self.terminator)
        pattern += (b"([0-9A-F]{2})" if self.summed else b"()") + re.escape(self.ending)
        found = re.search(pattern, data) if self.header else re.fullmatch(pattern, data)
        if found is None:
            return None
        return found[1] if self.wrap(found[1]) == found[0] else None


def wrapping_of(framing: Any) -> Wrapping:
    """Of a `framing` as the file has it."""
    return Wrapping(
        _BYTES[framing.header],
        _BYTES[framing.terminator],
        _ENDINGS[framing.ending],
        framing.sum_check,
        framing.gap or 0.0,
    )


@dataclass(eq=False)
class Gadget:
    """Answers `aQ0?` and `aQ1?`, takes `aS=` with an acknowledgement and `aT=` without."""

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
        """Returns the unsolicited frame at `start`: mostly the weight, sometimes another."""
        if what < 2:
            return self.wrapping.wrap(self.letter.encode() + (b"N", b"OL?")[what])
        (weight,) = self.memory.read("listened", 0, 1, start)
        data = self.wrapping.wrap(b"%sW=%05d" % (self.letter.encode(), weight))
        self.said.append((start, start + len(data) * character, weight))
        return data
