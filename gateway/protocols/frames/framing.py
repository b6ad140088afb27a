"""The begin and end of a frame without protocol: header, terminator, length, gap, sum.

The framing of the Vigor VB-1COM (manual B-4: BFM#0 and #2 to #11, error numbers of BFM#29),
which is general enough for scales, barcode readers and inverters of any make:

    [header 0..4] data [terminator 0..4] [sum 2] [CR] [LF]

An LRC or CRC stands behind the data, before the terminator:

    [header 0..4] data [LRC or CRC] [terminator 0..4] [CR] [LF]
"""

from dataclasses import dataclass
from typing import Literal

from gateway.errors import BadValue, ConfigError
from gateway.protocols.checksums import byte_sum, crc16, lrc
from gateway.protocols.frames.bytetext import octets

Preset = Literal["vb-1com", "vigor-rs", "ex485lnk-user", "k120s-drcv", "k120s-dsnd"]

DEFAULT_GAP = 0.1  # s; ends a frame that neither a terminator nor its length can end


End = Literal["terminator", "count", "gap"]
# Behind the data: the LRC of Modbus ASCII, or the CRC of Modbus RTU.
Check = Literal["lrc", "crc16"]

# The header bytes that the sum leaves out: the first, by the manuals; no recording confirms it.
SumHeaderRule = Literal["first_byte_only", "whole_header"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Framing:
    """One framing as in the file. With a `preset`, `presets.written_out` completes it.

    `length` is the exact number of data bytes, of any value; `max_length` ends a frame without
    another end. Both count data before conversion. `gap` in seconds, in steps of 10 ms. `ends`
    names all that may complete a frame, whichever is first; empty: the terminator or `length`
    where there is one, otherwise `max_length` or the gap.
    """

    preset: Preset | None = None
    format: int | None = None  # vb-1com: 1..9
    header: str = ""
    terminator: str = ""
    keep_terminator: bool = False  # the terminator belongs to the data (K120S DRCV)
    ending: Literal["", "CR", "CR LF"] = ""
    sum_check: bool = False
    sum_header_rule: SumHeaderRule = "first_byte_only"
    conversion: bool = False  # every data byte travels as two hex characters
    buffer: Literal[16, 8] = 16  # bits of a buffer word; 8 halves the longest frame
    length: int | None = None
    max_length: int | None = None
    gap: float | None = None
    ends: tuple[End, ...] = ()
    check: Check | None = None

    def __post_init__(self) -> None:
        for name, text in (("header", self.header), ("terminator", self.terminator)):
            if len(octets(text)) > 4:
                raise ConfigError(f"{name} {text!r} is longer than 4 bytes")
        if self.preset is None:
            self._check_by_hand()
        self._check_sums()
        for name, count in (("length", self.length), ("max_length", self.max_length)):
            if count is not None and not 1 <= count <= self.capacity:
                raise ConfigError(f"{name} {count} is not 1..{self.capacity}")
        if self.length is not None and self.max_length is not None:
            raise ConfigError("length is exact, max_length is not: write one of them")
        self._check_gap()
        self._check_ends()

    def _check_sums(self) -> None:
        if self.keep_terminator and not self.terminator:
            raise ConfigError("keep_terminator needs a terminator")
        if self.keep_terminator and (self.sum_check or self.ending):
            raise ConfigError("keep_terminator: a sum, CR or LF cannot follow")
        if self.check == "crc16" and self.mark and self.length is None and not self.conversion:
            raise ConfigError(
                "crc16 is two bytes of any value: end the frame by length or gap, or set conversion"
            )
        if self.check is not None and (self.sum_check or self.keep_terminator):
            raise ConfigError("a frame has one check: sum_check (or keep_terminator), or check")

    def _check_ends(self) -> None:
        ends = self.ends
        if not ends:
            return
        if self.length is not None:
            raise ConfigError("length is exact and ends the frame: ends belongs to max_length")
        if len(set(ends)) < len(ends):
            raise ConfigError(f"ends names one of {', '.join(ends)} twice")
        if "count" in ends and self.max_length is None:
            raise ConfigError("ends: count is the number in max_length, which is missing")
        marked = bool(self.mark)
        if ("terminator" in ends) != marked and self.preset is None:
            missing = "needs a terminator or ending" if not marked else "must name the terminator"
            raise ConfigError(f"ends {missing}")
        if "count" in ends and marked and len(self.mark + self.tail) > 1:
            raise ConfigError("ends: count and a terminator: it has one byte, and no LF behind it")
        if self.sum_check and ends != ("terminator",):
            raise ConfigError("ends: with sum_check only the terminator ends a frame")

    def _check_by_hand(self) -> None:
        if self.format is not None:
            raise ConfigError("format belongs to preset vb-1com")
        if self.sum_check and not self.terminator:
            raise ConfigError("sum_check needs a terminator: the sum stands behind it")

    def _check_gap(self) -> None:
        if self.gap is None:
            return
        steps = self.gap * 100
        if not 1 <= steps <= 32767 or abs(steps - round(steps)) > 1e-6:
            raise ConfigError(f"gap {self.gap:g} s is not 10 ms to 327.67 s in steps of 10 ms")

    @property
    def capacity(self) -> int:
        """The data bytes that the longest frame can hold."""
        return 512 if self.buffer == 16 else 256

    @property
    def longest(self) -> int:
        """The most data bytes of a frame."""
        return self.length or self.max_length or self.capacity

    @property
    def mark(self) -> bytes:
        """The end of the data: the terminator, or the CR where there is no terminator."""
        return octets(self.terminator) or self._ending[:1]

    @property
    def tail(self) -> bytes:
        """The CR and LF behind mark and sum."""
        return self._ending if self.terminator else self._ending[1:]

    @property
    def _ending(self) -> bytes:
        return {"": b"", "CR": b"\r", "CR LF": b"\r\n"}[self.ending]

    @property
    def gap_timeout(self) -> float | None:
        """Seconds of silence that end a frame, or cut it short; None where it does neither."""
        if self.gap is None and (not self.mark or self.ends_by_gap):
            return DEFAULT_GAP
        return self.gap

    @property
    def ends_by_gap(self) -> bool:
        """True when a frame is complete after a silence, not cut short."""
        if self.ends:
            return "gap" in self.ends
        return not self.mark and self.length is None

    @property
    def ends_by_count(self) -> bool:
        """True when a frame is complete with its longest data."""
        return "count" in self.ends if self.ends else not self.mark

    @property
    def longest_on_line(self) -> int:
        """The most characters between the header and the terminator."""
        return (self.longest + self.check_size) * (2 if self.conversion else 1)

    @property
    def check_size(self) -> int:
        """The bytes of the LRC or CRC, before conversion."""
        if self.check is None:
            return 0
        return 1 if self.check == "lrc" and self.conversion else 2

    def check_of(self, data: bytes) -> bytes:
        """Returns the LRC or CRC of data before conversion; the LRC as two hexadecimal
        characters, unless conversion makes these of it."""
        match self.check:
            case "lrc":
                value = lrc(data)
                return bytes([value]) if self.conversion else b"%02X" % value
            case "crc16":
                return crc16(data)
            case None:
                return b""

    def on_line(self, count: int) -> int:
        """Returns the characters of a frame with `count` data bytes, everything included."""
        data = (count + self.check_size) * (2 if self.conversion else 1)
        around = octets(self.header) + self.mark + self.tail
        return data + len(around) + (2 if self.sum_check else 0)

    def sum_of(self, header: bytes, data: bytes) -> bytes:
        """Returns the sum of the characters from behind the header to the terminator."""
        left_out = 1 if self.sum_header_rule == "first_byte_only" else len(header)
        return byte_sum(header[left_out:] + data + octets(self.terminator))

    def encode(self, payload: bytes) -> bytes:
        """Returns the whole frame around `payload`. Raises `BadValue` for data it cannot carry."""
        if len(payload) > self.capacity:
            raise BadValue(f"{len(payload)} bytes of data, a frame holds {self.capacity}")
        if self.keep_terminator:
            return payload
        header, terminator = octets(self.header), octets(self.terminator)
        checked = payload + self.check_of(payload)
        data = checked.hex().upper().encode() if self.conversion else checked
        if self.length is None:
            self._refuse_marks(data)
        total = self.sum_of(header, data) if self.sum_check else b""
        return header + data + terminator + total + self._ending

    def _refuse_marks(self, data: bytes) -> None:
        """Refuses data with header, terminator or CR: they would end the frame too early (B-4)."""
        header, mark = octets(self.header), self.mark
        if not mark:
            return
        line, at = header + data + mark, len(header) + len(data)
        if line.find(mark, len(header)) != at or (self.ending and b"\r" in data):
            raise BadValue(f"the data {data!r} holds what ends the frame")
        if header and line.rfind(header, 1, at) > 0:
            raise BadValue(f"the data {data!r} holds the header")
