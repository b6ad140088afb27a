"""A small AT modem, byte by byte: pure, with the time passed in. It is no copy of the gateway's.

It obeys V.250 as a modem of the 1990s does: echo until ATE0, results as words until ATV0, +++ only
between two guard times, and nothing but data in a call.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

NEVER = float("inf")
CRLF = b"\r\n"


@dataclass
class ModemModel:
    """`dials`: what each dial comes to, in turn; the last one stays. `after`: seconds until then.

    `answers`: the station at the other end of the call: gets its bytes, returns its reply.
    """

    dials: Sequence[str] = ("CONNECT 9600",)
    after: float = 0.01
    answers: Callable[[bytes], bytes] = lambda data: b""
    guard: float = 0.05
    errors: frozenset[str] = frozenset()  # commands that it answers ERROR
    hung_up: str = ""  # its result of ATH, in place of OK
    deaf: bool = False  # it answers no command
    echo: bool = True
    online: bool = False
    commands: list[str] = field(default_factory=list)
    data: bytes = b""  # that went over the line
    calls: int = 0
    _line: bytes = b""
    _plus: bytes = b""
    _last: float = -NEVER  # the last byte of the gateway
    _escape_at: float = NEVER
    _result_at: float = NEVER
    _result: str = ""
    _in_call: bool = False  # the call goes on in command mode too

    @property
    def due(self) -> float:
        return min(self._escape_at, self._result_at)

    def feed(self, data: bytes, now: float) -> bytes:
        """Takes bytes of the gateway. Returns what goes back to it at once."""
        if self.online:
            return self._data(data, now)
        out = data if self.echo and not self.deaf else b""
        self._last = now
        for byte in data:
            if byte in b"\r":
                line, self._line = self._line.decode("ascii", "replace"), b""
                out += self._command(line.strip(), now)
            else:
                self._line += bytes([byte])
        return out

    def tick(self, now: float) -> bytes:
        out = b""
        if self._escape_at <= now:
            self._escape_at, self.online, self._plus = NEVER, False, b""
            out += self._word("OK")
        if self._result_at <= now:
            self._result_at = NEVER
            out += self._end_dial()
        return out

    def ring(self) -> bytes:
        return CRLF + b"RING" + CRLF

    def drop(self) -> bytes:
        """Loses the carrier."""
        self.online = self._in_call = False
        self._escape_at = NEVER
        return self._word("NO CARRIER")

    def connect(self) -> bytes:
        """Has the carrier, at the end of a dial or by itself."""
        self._result, self._result_at = "CONNECT 9600", NEVER
        return self._end_dial()

    def _end_dial(self) -> bytes:
        result = self._result
        if result.startswith("CONNECT"):
            self.online = self._in_call = True
            self.calls += 1
        return self._word(result) if result else b""

    def _data(self, data: bytes, now: float) -> bytes:
        quiet, self._last = now - self._last >= self.guard, now
        if data.strip(b"+") == b"" and (quiet or self._plus) and len(self._plus + data) <= 3:
            self._plus += data
            self._escape_at = now + self.guard if self._plus == b"+++" else NEVER
            return b""
        sent, self._plus, self._escape_at = self._plus + data, b"", NEVER
        self.data += sent
        return self.answers(sent)

    def _command(self, line: str, now: float) -> bytes:
        line = line.upper()
        if self._result_at < NEVER:  # any character breaks off a dial
            self._result_at = NEVER
            return self._word("NO CARRIER")
        if self.deaf or not line:
            return b""
        self.commands.append(line)
        if line in self.errors or not line.startswith("AT"):
            return self._word("ERROR")
        if line.startswith("ATD"):
            return self._dial(now)
        if line == "ATA":
            self._result, self._result_at = "CONNECT 9600", now + self.after
            return b""
        if line == "ATZ":
            self.echo = True
        if "E0" in line:
            self.echo = False
        if line == "ATH":
            self._in_call = False
            if self.hung_up:
                return self._word(self.hung_up)
        return self._word("OK")

    def _dial(self, now: float) -> bytes:
        self._result, *rest = self.dials
        self.dials = rest or self.dials
        self._result_at = now + self.after
        if self._result == "":  # nobody answers, and the modem waits on
            self._result_at = 1e9
        return b""

    def _word(self, word: str) -> bytes:
        return b"" if self.deaf else CRLF + word.encode() + CRLF
