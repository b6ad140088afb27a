"""The silence before a request to one station, and what was too short for it."""

from dataclasses import dataclass, field

FORGOTTEN_AFTER = 3600.0  # seconds until a silence that was too short may be tried again
MOST_DOUBLED = 20  # a century
ROUNDING = 0.002  # seconds by which a timer makes a silence longer


@dataclass(slots=True, eq=False)
class StationSilence:
    """Seconds of silence on the wire before a request to one station."""

    safe: float  # of the file, or of the protocol
    least: float  # the shortest that may be tried; `safe`: it is never shortened
    kept: float = field(init=False)  # before its next request
    shorter: float = field(init=False)  # before a poll at the present step of the line
    tested_below: float = field(init=False)  # a reply after less than this proves the present step
    _floor: float = 0.0  # until `_until`
    _until: float = 0.0  # by the line's clock
    _losses: int = 0

    def __post_init__(self) -> None:
        self.shorter = self.safe
        self.keep_safe(at_rest=True)

    @property
    def learns(self) -> bool:
        """True if it may be shortened."""
        return self.least < self.safe

    def keep_safe(self, *, at_rest: bool) -> None:
        """Keeps the safe silence before the next request. `at_rest`: the line shortens none."""
        self.kept = self.safe
        self.tested_below = self.safe + ROUNDING if at_rest and self.learns else 0.0

    def keep(self, seconds: float) -> None:
        """Keeps so many seconds before the next request, but no more than the safe silence."""
        if seconds < self.safe:
            self.kept, self.tested_below = seconds, seconds + ROUNDING

    def take_step(self, step: int, now: float) -> None:
        """Halves the safe silence `step` times, as far as it was not too short recently."""
        floor = self._floor if now < self._until else 0.0
        self.shorter = min(max(self.safe / 2**step, floor, self.least), self.safe)

    def was_too_short(self, seconds: float, now: float, times: int = 1) -> None:
        """Remembers that a request after so many seconds was lost, twice as long each time.

        `times`: so many times as long.
        """
        self._floor = max(2 * seconds, self._floor)
        self._until = now + times * FORGOTTEN_AFTER * 2**self._losses
        self._losses = min(self._losses + 1, MOST_DOUBLED)

    def held(self, now: float) -> None:
        """Forgets earlier losses, unless the last one is still remembered."""
        if now >= self._until:
            self._losses, self._floor = 0, 0.0
