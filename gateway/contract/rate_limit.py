"""A limit on how fast log lines are written, so that no client can fill the disk with them."""

from dataclasses import dataclass


@dataclass(slots=True)
class RateLimit:
    """Allows `burst` events at once, then one every `every` seconds; counts the others."""

    burst: int
    every: float
    suppressed: int = 0  # since the start
    _reported: int = 0
    _allowance: float = 0.0
    _last: float = float("-inf")

    def allows(self, now: float) -> bool:
        """`now`: seconds of a monotonic clock."""
        gained = (now - self._last) / self.every
        self._allowance = min(float(self.burst), self._allowance + gained)
        self._last = now
        if self._allowance < 1.0:
            self.suppressed += 1
            return False
        self._allowance -= 1.0
        return True

    def idle_since(self, now: float) -> float:
        """Returns the seconds since the last event, allowed or not."""
        return now - self._last

    def newly_suppressed(self) -> int:
        """Returns the number of events suppressed since the previous call."""
        new, self._reported = self.suppressed - self._reported, self.suppressed
        return new
