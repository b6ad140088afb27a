"""Listening to a device that speaks when it likes: bytes in, what they say out, in order.

Pure: the line gives it the bytes and the time, wakes it when `due`, and sends its answers.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from gateway.errors import Evidence, Garbled
from gateway.protocols.frames.device import Frames, Heard

_QUIET = 0.05  # s; after it a byte begins a frame, where nothing else says what begins one
_LONGEST_PAUSE = 1.0  # s; voids half a frame where the framing has no gap: its rest is lost


@dataclass(frozen=True, slots=True)
class Stale:
    """These fields were not heard for longer than their `stale_after`."""

    fields: frozenset[str]


Said = Heard | Garbled | Stale


class Listener:
    """What one device says unasked while its port is open.

    `Garbled` is damage, or a frame that `listen` does not know: whatever the device wanted to say,
    none of its listened fields can be called known until they are heard again. A frame that may
    be ignored has a `listen` entry without fields.
    """

    def __init__(self, device: Frames, now: float) -> None:
        """`now` is when the port was opened: a frame may be on its way already."""
        self._device = device
        self._reader = device.reader(quiet=False)
        self._last_byte = now
        self._stale_at: dict[str, float] = {}
        for one in device.listen.values():
            if one.stale_after is not None:
                for name in one.fields:
                    self._stale_at[name] = now + one.stale_after

    @property
    def due(self) -> float | None:
        """When `tick` has something to do; None: not before bytes arrive."""
        times = list(self._stale_at.values())
        if self._reader.pending:
            times.append(self._last_byte + self._gap)
        return min(times, default=None)

    @property
    def busy_until(self) -> float | None:
        """While it is in the middle of a frame: until when its next byte may come."""
        if not self._reader.pending:
            return None
        gap = self._reader.gap_timeout
        return self._last_byte + (_QUIET if gap is None else max(gap, _QUIET))

    @property
    def silent(self) -> bool:
        """Whether all that it should say again and again is overdue."""
        return not self._stale_at

    @property
    def _gap(self) -> float:
        gap = self._reader.gap_timeout
        return _LONGEST_PAUSE if gap is None else gap

    def received(self, data: bytes, now: float) -> list[Said]:
        """Bytes that arrived at `now`."""
        said = self._silence(now)
        self._last_byte = now
        return said + self._said(self._reader.feed(data), now)

    def tick(self, now: float) -> list[Said]:
        """Time has passed."""
        said = self._silence(now)
        stale = frozenset(name for name, due in self._stale_at.items() if due <= now)
        for name in stale:
            del self._stale_at[name]
        return [*said, Stale(stale)] if stale else said

    def overheard(self, frames: Iterable[bytes], now: float) -> list[Said]:
        """Whole frames that came while the device was asked for something else."""
        heard = (self._understood(frame, now) for frame in frames)
        return [news for news in heard if not isinstance(news, Garbled)]

    def disturbed(self, now: float) -> None:
        """Others have spoken on the line: what was half heard is void."""
        self._reader = self._device.reader(quiet=False)
        self._last_byte = now

    def _silence(self, now: float) -> list[Said]:
        """What the silence up to `now` ended, by the time of the bytes, whoever woke us late."""
        # Reckoned as `due` is: a difference of the same times could fall short of the gap.
        if now >= self._last_byte + self._gap:
            return self._said(self._reader.expire(), now)
        if now >= self._last_byte + _QUIET:
            self._reader.settle()
        return []

    def _said(self, frames: list[bytes | Garbled], now: float) -> list[Said]:
        """Damage upon damage is told once: noise must not fill lists."""
        said: list[Said] = []
        for item in frames:
            news = item if isinstance(item, Garbled) else self._understood(item, now)
            if not (isinstance(news, Garbled) and said and isinstance(said[-1], Garbled)):
                said.append(news)
        return said

    def _understood(self, frame: bytes, now: float) -> Said:
        heard = self._device.hear(frame)
        if heard is None:
            return Garbled("a frame that listen does not know", frame, evidence=Evidence.SHAPE)
        stale_after = self._device.listen[heard.message].stale_after
        for name in heard.values:
            self._stale_at.pop(name, None)
            if stale_after is not None:
                self._stale_at[name] = now + stale_after
        return heard
