"""The result of one seed."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Story:
    """`broken`: the broken rules with their times; `trace`: a hash of all events."""

    seed: int
    hours: float
    pace: str = "busy"
    only: tuple[str, ...] = ()  # kinds of faults that happened; empty: all
    broken: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    trace: str = ""

    def replay(self) -> str:
        only = f" ONLY={','.join(self.only)}" if self.only else ""
        return f"make sim SEEDS={self.seed} HOURS={self.hours:g} PACE={self.pace}{only}"
