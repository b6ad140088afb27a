"""The result of one seed."""

from collections import Counter
from dataclasses import dataclass, field

# Words of a report, and the rule of docs/contributors/proof.md that it breaks.
_RULES = {
    "transfer ": "transfer",
    "a foreign reply is a value": "foreign reply",
    "internal error": "internal error",
    "which was not in the PLC": "wrong value",
    "which was not said": "wrong value",
    "is not fresh": "wrong value",
    "came after its time-out": "answer after its time-out",
    "of silence before": "silence",
    "write of": "write",
    "writes were sent": "sent twice",
    "is told as done": "write",
    "reported as done": "write",
    "was told, and is not there": "write",
    "did not get it": "write",
    "sent": "command",
    "did not arrive": "command",
    "is still good after": "too old",
    "is still shown as good": "too old",
    "goes back": "order",
    "go back": "order",
    "never published": "wrong value",
    "the answer": "answers",
    "an answer": "answers",
    "no right end": "answers",
    "no whole answer": "answers",
    "instead of one value": "answers",
    "failed": "the run itself",
    "is still good,": "bad in time",
    "at the end": "good at the end",
    "ended": "good in time",
    "was not read for": "not polled",
    "spoke": "sends while a station sends",
    "open at once": "Modbus TCP numbers",
    "is used again": "Modbus TCP numbers",
    "another station": "Modbus TCP numbers",
    "is answered": "unsolicited frames",
    "was not told": "unsolicited frames",
    "in the queues": "accumulates",
    "requests wait": "accumulates",
    "replies wait": "accumulates",
    "timers are waiting": "accumulates",
    "still remembered": "accumulates",
    "opened": "accumulates",
    "not served": "not configured",
    "not configured": "not configured",
    "disabled": "not configured",
}


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

    def rules(self) -> Counter[str]:
        """Counts the broken rules."""
        return Counter(rule_of(what) for what in self.broken)


def rule_of(what: str) -> str:
    """Returns the rule that a report says is broken."""
    for words, rule in _RULES.items():
        if words in what:
            return rule
    return "the run itself"
