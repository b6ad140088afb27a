"""The result of one seed."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Story:
    """`broken`: the rules that were broken, when and how; `trace`: a hash of all of it."""

    seed: int
    hours: float
    pace: str = "busy"
    broken: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    trace: str = ""

    def replay(self) -> str:
        return f"make sim SEEDS={self.seed} HOURS={self.hours:g} PACE={self.pace}"
