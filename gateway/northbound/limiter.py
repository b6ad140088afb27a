"""So that nobody can fill a disk with log lines: so many at once, then one now and again."""

from dataclasses import dataclass


@dataclass(slots=True)
class Limiter:
    """Lets `burst` through at once and then one every `every` seconds; counts the others."""

    burst: int
    every: float
    held: int = 0  # since the start
    _told: int = 0
    _room: float = 0.0
    _last: float = float("-inf")

    def allows(self, now: float) -> bool:
        """`now`: seconds of a monotonic clock."""
        gained = (now - self._last) / self.every
        self._room = min(float(self.burst), self._room + gained)
        self._last = now
        if self._room < 1.0:
            self.held += 1
            return False
        self._room -= 1.0
        return True

    def untold(self) -> int:
        """How many were held back since this was last asked."""
        untold, self._told = self.held - self._told, self.held
        return untold
