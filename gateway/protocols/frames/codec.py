"""Bytes to frames and back for devices without a protocol, in bounded memory.

A frame here is its data, without header, terminator, sum, CR and LF, and without conversion.
"""

from functools import lru_cache

from gateway.errors import Evidence, Garbled
from gateway.protocols.frames.bytetext import octets
from gateway.protocols.frames.framing import Framing
from gateway.protocols.frames.presets import written_out

_PIECE = 1024  # bytes per step: the buffer never holds more than this and one frame
_HEX = frozenset(b"0123456789ABCDEFabcdef")


class FrameReader:
    """The receiving side of a framing. It continues after damage, so it can listen for years.

    A frame is complete by its length, its terminator, or a gap. Bytes before a header are
    skipped, also a frame without an end. Without a header, a frame can begin only after the end
    of another or after a silence: with `quiet=False`, and after damage, all bytes up to there
    are discarded.
    """

    def __init__(self, framing: Framing, *, quiet: bool = True) -> None:
        self._framing = framing = written_out(framing)
        self._header = octets(framing.header)
        self._mark = framing.mark
        self._longest = framing.longest_on_line
        self._counted = False  # the last frame ended by its count: its terminator may follow
        self._after = (2 if framing.sum_check else 0) + len(framing.tail)
        self._buffer = bytearray()
        self._aligned = quiet or bool(self._header)

    @property
    def gap_timeout(self) -> float | None:
        """Seconds without a byte until the call of `expire`; None: never."""
        return self._framing.gap_timeout

    @property
    def pending(self) -> int:
        """The number of bytes kept: part of a frame, or still undecided."""
        return len(self._buffer)

    @property
    def aligned(self) -> bool:
        """False until a silence, or the end of a frame, shows where the next one begins."""
        return self._aligned

    def feed(self, data: bytes) -> list[bytes | Garbled]:
        """Returns the frames completed by `data`, and damage among them, in order.

        Consecutive damage is returned once.
        """
        found: list[bytes | Garbled] = []
        for start in range(0, len(data), _PIECE):
            self._buffer += data[start : start + _PIECE]
            while (cut := self._cut()) is not None:
                _append(found, cut)
        return found

    def expire(self) -> list[bytes | Garbled]:
        """Returns the frames ended by the gap: complete ones, or damage where one was cut short."""
        found: list[bytes | Garbled] = []
        while self._hunt():
            _append(found, self._ended_by_gap())
            while (cut := self._cut()) is not None:  # a whole frame behind a false header
                _append(found, cut)
        self._buffer.clear()
        self._aligned, self._counted = True, False
        return found

    def settle(self) -> None:
        """Notes a silence after which the next byte begins a frame."""
        if not self._aligned:
            self._buffer.clear()
            self._aligned = True

    def _ended_by_gap(self) -> bytes | Garbled:
        framing, body = self._framing, len(self._header)
        if framing.ends_by_gap and (not self._mark or self._end_of_data(len(self._buffer)) is None):
            data = bytes(self._buffer[body:])
            if len(data) > self._longest:  # fewer bytes more than the terminator has
                return self._endless(body + self._longest)
            self._buffer.clear()
            return self._data(data)
        damage = Garbled(
            f"cut short: {self._missing()}", bytes(self._buffer), evidence=Evidence.TRUNCATED
        )
        self._drop(1 if self._header else len(self._buffer))
        return damage

    def _missing(self) -> str:
        framing, body = self._framing, len(self._header)
        is_counted = framing.ends_by_count or framing.length is not None
        if is_counted and len(self._buffer) - body < self._longest:
            return f"fewer than {framing.longest} bytes of data"
        at = self._end_of_data(len(self._buffer))
        if at is None:
            return self._no_mark()
        missing = self._after - (len(self._buffer) - at - len(self._mark))
        if missing > len(framing.tail):
            return "error 4, sum missing"
        return "error 8, LF missing" if missing == 1 and framing.ending == "CR LF" else _NO_CR

    def _no_mark(self) -> str:
        if not self._mark:
            return "no gap"
        return "error 10, terminator missing" if self._framing.terminator else _NO_CR

    def _cut(self) -> bytes | Garbled | None:
        """Takes one frame, or one piece of damage, off the buffer; None while it is incomplete."""
        if not self._hunt():
            return None
        framing, most = self._framing, len(self._header) + self._longest
        by_count = framing.ends_by_count
        at = self._end_of_data(most - 1 if by_count else most) if self._mark else None
        if at is None:
            if by_count:
                return self._finish(most, counted=True) if len(self._buffer) >= most else None
            if len(self._buffer) < most + max(1, len(self._mark)):
                return None
            return self._endless(most)
        if framing.length is None and self._header:
            # The data cannot hold a header: this one begins the frame, the one before it is noise.
            again = self._buffer.rfind(self._header, 1, at)
            if again > 0:
                self._drop(again)
                return self._cut()
        return self._finish(at)

    def _endless(self, most: int) -> Garbled:
        why = f"{self._no_mark()} after {self._framing.longest} bytes of data"
        again = -1
        if self._header and self._framing.length is None:
            again = self._buffer.rfind(self._header, 1, most + len(self._mark))
        if again < 0:
            return self._damage(why, most)
        damage = Garbled(why, bytes(self._buffer), evidence=Evidence.TRUNCATED)
        self._drop(again)
        return damage

    def _end_of_data(self, most: int) -> int | None:
        """Returns the place of the mark, with data up to `most`; None: not received (yet)."""
        if self._framing.length is not None:
            at = len(self._header) + self._longest
            return at if self._buffer.startswith(self._mark, at) else None
        at = self._buffer.find(self._mark, len(self._header), most + len(self._mark))
        return at if at >= 0 else None

    def _finish(self, at: int, *, counted: bool = False) -> bytes | Garbled | None:
        """Checks the bytes behind the data, which ends at `at`, and takes the frame.

        `counted`: its count ended it, before a terminator came.
        """
        framing, body = self._framing, len(self._header)
        data = bytes(self._buffer[body:at])
        end = at if counted else at + len(self._mark)
        if framing.sum_check:
            end += 2
            if len(self._buffer) < end:
                return None
            got = self._buffer[end - 2 : end]
            if got.upper() != framing.sum_of(self._header, data):
                why = "error 4, wrong sum"
                return self._damage(why, end, evidence=Evidence.CHECKSUM, aligned=True)
        for wanted_byte, why in zip(framing.tail, _tail_errors(framing.tail), strict=True):
            if len(self._buffer) == end:
                return None
            if self._buffer[end] != wanted_byte:
                return self._damage(why, end)
            end += 1
        result = self._data(data)
        if isinstance(result, Garbled):
            return self._damage(
                str(result), end, evidence=result.evidence, aligned=bool(self._mark)
            )
        self._drop(end)
        self._counted = counted
        return result + self._mark if framing.keep_terminator and not counted else result

    def _data(self, data: bytes) -> bytes | Garbled:
        """Returns the data without conversion and check."""
        framing, plain = self._framing, data
        if framing.conversion:
            if len(data) % 2 or not _HEX.issuperset(data):
                return Garbled("error 3, a character that is no hex digit", data)
            plain = bytes.fromhex(data.decode("ascii"))
        if framing.check is None:
            return plain
        payload = plain[: len(plain) - framing.check_size]
        got, wanted = plain[len(payload) :], framing.check_of(payload)
        if framing.check == "lrc" and not framing.conversion:
            got = got.upper()
        if got != wanted:
            return Garbled(f"wrong {framing.check}", data, evidence=Evidence.CHECKSUM)
        return payload

    def _damage(
        self,
        why: str,
        end: int,
        *,
        evidence: Evidence = Evidence.NOISE,
        aligned: bool = False,
    ) -> Garbled:
        """Discards damage; with a header only its first byte, because a good frame may follow."""
        damage = Garbled(why, bytes(self._buffer), evidence=evidence)
        if self._header:
            self._drop(1)
        else:
            self._drop(end)
            self._aligned = aligned
        return damage

    def _hunt(self) -> bool:
        """Skips noise; returns True when the buffer begins with a frame."""
        if self._header:
            self._drop_to(self._buffer.find(self._header), keep=len(self._header) - 1)
            return self._buffer.startswith(self._header)
        if not self._aligned:
            self._align()
        if self._counted and self._buffer:
            self._counted = False
            if self._mark and self._buffer.startswith(self._mark):
                self._drop(len(self._mark))
        return self._aligned and bool(self._buffer)

    def _align(self) -> None:
        if not self._mark:
            self._buffer.clear()  # only a gap shows the begin of a frame
            return
        self._drop_to(self._buffer.find(self._mark), keep=len(self._mark) - 1)
        end = len(self._mark) + self._after
        if self._buffer.startswith(self._mark) and len(self._buffer) >= end:
            self._drop(end)
            self._aligned = True

    def _drop_to(self, at: int, keep: int) -> None:
        self._drop(at if at >= 0 else max(0, len(self._buffer) - keep))

    def _drop(self, count: int) -> None:
        del self._buffer[:count]


class FrameCodec:
    """The codec of one transaction: raises the first damage."""

    def __init__(self, receive: Framing, send: Framing | None = None) -> None:
        self._reader = FrameReader(receive)
        self._send = written_out(receive if send is None else send)
        self._damage: Garbled | None = None

    @property
    def pending(self) -> int:
        """The number of bytes kept: part of a frame."""
        return self._reader.pending

    @property
    def gap_timeout(self) -> float | None:
        """Seconds without a byte until the call of `expire`; None: never."""
        return self._reader.gap_timeout

    def encode(self, frame: bytes) -> bytes:
        """Raises `BadValue` for data that this framing cannot carry."""
        return self._send.encode(frame)

    def feed(self, data: bytes) -> list[bytes]:
        """Returns the frames completed by `data`. Raises `Garbled`, after the frames before it."""
        return self._strictly(self._reader.feed(data))

    def expire(self) -> list[bytes]:
        """Returns the frames ended by a gap of `gap_timeout`. Raises `Garbled`."""
        return self._strictly(self._reader.expire())

    def _strictly(self, found: list[bytes | Garbled]) -> list[bytes]:
        frames: list[bytes] = []
        for item in found:
            if isinstance(item, Garbled):
                self._damage = self._damage or item
            elif self._damage is None:
                frames.append(item)
        if self._damage is not None and not frames:
            raise self._damage
        return frames


_NO_CR = "error 7, CR missing"


@lru_cache(maxsize=8)
def _tail_errors(tail: bytes) -> tuple[str, ...]:
    return tuple(_NO_CR if byte == 0x0D else "error 8, LF missing" for byte in tail)


def _append(found: list[bytes | Garbled], item: bytes | Garbled) -> None:
    if not (isinstance(item, Garbled) and found and isinstance(found[-1], Garbled)):
        found.append(item)
