"""Decodes unsolicited frames: bytes in, decoded frames, damage and stale fields out, in order."""

from gateway.errors import Evidence, Garbled
from gateway.protocols.frames.device import Frames
from gateway.protocols.frames.presets import written_out
from gateway.protocols.unsolicited import Stale, UnsolicitedEvent

_QUIET = 0.05  # s; a byte after it begins a frame, where no header marks the begin
_LATE = 0.01  # s; a tick that is later is asked again: bytes may have arrived, and wait
_AGAIN = 4  # late ticks, one in each round of the event loop; then bytes that waited were read
_LONGEST_PAUSE = 1.0  # s; discards half a frame where the framing has no gap: its rest is lost


class Listener:
    """Decodes the unsolicited frames of one device while its port is open.

    `Garbled` is damage, or a frame without an entry in `listen`: after it no field in `listen` is
    known until it is received again. A frame to ignore has a `listen` entry without fields.

    Only a `tick` shows a silence, never the time of the next byte: that byte may have waited while
    the process got no processor.
    """

    def __init__(self, device: Frames, now: float) -> None:
        """`now`: the port was opened, possibly in the middle of a frame."""
        self._device = device
        self._reader = device.reader(quiet=False)
        self._has_header = self._reader.aligned
        self._last_byte = now
        self._late = 0  # late ticks since the last byte or silence
        self._stale_at: dict[str, float] = {}
        for one in device.listen.values():
            if one.stale_after is not None:
                for name in one.fields:
                    self._stale_at[name] = now + one.stale_after

    @property
    def due(self) -> float | None:
        """The time of the next `tick`; None: not before bytes arrive."""
        times = list(self._stale_at.values())
        if (silent := self._silent_at) is not None:
            times.append(silent)
        return min(times, default=None)

    @property
    def _silent_at(self) -> float | None:
        """The time at which a silence means something."""
        if not self._reader.aligned:
            return self._last_byte + min(_QUIET, self._gap)
        return self._last_byte + self._gap if self._reader.pending else None

    @property
    def busy_until(self) -> float | None:
        """The latest time of the next byte of an incomplete frame; None between two frames."""
        if not self._reader.pending:
            return None
        gap = self._reader.gap_timeout
        return self._last_byte + (_QUIET if gap is None else max(gap, _QUIET))

    @property
    def all_stale(self) -> bool:
        """True when every field with a `stale_after` is stale."""
        return not self._stale_at

    @property
    def _gap(self) -> float:
        gap = self._reader.gap_timeout
        return _LONGEST_PAUSE if gap is None else gap

    def received(self, data: bytes, now: float) -> list[UnsolicitedEvent]:
        """Decodes bytes that arrived at `now`."""
        said: list[UnsolicitedEvent] = []
        if self._reader.pending and (self._silent_at or now) < now:
            said.append(Garbled("its bytes may have waited", evidence=Evidence.TRUNCATED))
            self._reader = self._device.reader(quiet=False)
        self._last_byte, self._late = now, 0
        return said + self._events(self._reader.feed(data), now)

    def tick(self, now: float) -> list[UnsolicitedEvent]:
        """Ends frames by silence, and marks fields as stale."""
        said = self._silence(now)
        stale = frozenset(name for name, due in self._stale_at.items() if due <= now)
        for name in stale:
            del self._stale_at[name]
        return [*said, Stale(stale)] if stale else said

    def framed_as(self, driver: object) -> bool:
        """Returns True for a driver with the same framing."""
        other = getattr(driver, "settings", None)
        return isinstance(other, Frames) and other.framing == self._device.framing

    def unmatched(self, frame: bytes, now: float) -> list[UnsolicitedEvent]:
        """Decodes a frame of a transaction that is not its reply; ignores an unknown one.

        On two wires the request may have covered its first characters: only a header shows that
        it is whole.
        """
        if not self._has_header:
            return []
        event = self._decoded(frame, now)
        return [] if isinstance(event, Garbled) else [event]

    def restart(self, now: float, *, whole: bool) -> None:
        """Discards an incomplete frame, because other frames were on the line.

        After a whole reply the next byte begins a frame; a silence need not show it. After one
        that ended by its count a terminator may follow.
        """
        begins = whole and not written_out(self._device.framing).ends_by_count
        self._reader = self._device.reader(quiet=begins)
        self._last_byte = now

    def _silence(self, now: float) -> list[UnsolicitedEvent]:
        """Ends frames by the silence up to `now`, counted from the last byte."""
        silent = self._silent_at
        if silent is None or now < silent:
            return []
        if now > silent + _LATE and self._late < _AGAIN:
            self._late += 1  # `due` has passed: it is asked again at once
            return []
        self._late = 0
        # Computed as in `due`: a difference of the same times could be less than the gap.
        if now >= self._last_byte + self._gap:
            return self._events(self._reader.expire(), now)
        self._reader.settle()
        return []

    def _events(self, frames: list[bytes | Garbled], now: float) -> list[UnsolicitedEvent]:
        """Returns consecutive damage once: noise must not fill lists."""
        said: list[UnsolicitedEvent] = []
        for item in frames:
            news = item if isinstance(item, Garbled) else self._decoded(item, now)
            if not (isinstance(news, Garbled) and said and isinstance(said[-1], Garbled)):
                said.append(news)
        return said

    def _decoded(self, frame: bytes, now: float) -> UnsolicitedEvent:
        decoded = self._device.decode(frame)
        if decoded is None:
            return Garbled("a frame that listen does not know", frame, evidence=Evidence.SHAPE)
        stale_after = self._device.listen[decoded.message].stale_after
        for name in decoded.values:
            self._stale_at.pop(name, None)
            if stale_after is not None:
                self._stale_at[name] = now + stale_after
        return decoded
