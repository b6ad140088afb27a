"""Identity of one device: compares what the file says with what the device tells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.errors import NO_TROUBLE, Diagnosis

NEVER = float("inf")
RECHECK = 10.0  # seconds between two questions where the wire has no time left
SHARE = 0.01  # of the wire time then, for all devices of a line together
SHORTEST, FREE_SHARE = 1.0, 0.25  # seconds between two; of the time that polls leave
SILENT_TRIES = 3  # questions without a reply after which a device tells nothing
SILENT_FOR = 3600.0  # seconds until a silent one is asked again
PAUSE = 1.0  # seconds after a question that failed, doubled up to `RECHECK`


class Verdict(StrEnum):
    """The result of the last question."""

    UNKNOWN = "unknown"  # it must be asked before anything else
    RIGHT = "right"
    WRONG = "wrong"  # its values are bad, and it takes no writes
    UNTOLD = "untold"  # it cannot tell: nothing is checked


@dataclass(slots=True, eq=False)
class Identity:
    """The identity of one device. Times in seconds of the line's clock.

    A device that never told its identity is used: it may lack the function. One that told it
    before and refuses it now is another device.
    """

    wanted: Mapping[str, str]
    verdict: Verdict = Verdict.UNKNOWN
    told: Mapping[str, Sequence[str]] = field(default_factory=dict)  # of the last reply
    why: Diagnosis = NO_TROUBLE  # if it is not right
    due: float = -NEVER  # when it is asked
    _has_told: bool = False
    _unanswered: int = 0  # questions in a row
    _silent_until: float = -NEVER

    @property
    def is_usable(self) -> bool:
        return self.verdict in (Verdict.RIGHT, Verdict.UNTOLD)

    @property
    def takes_requests(self) -> bool:
        """False while it is known that no question will be answered well soon."""
        return self.is_usable or (self.verdict is Verdict.UNKNOWN and not self._unanswered)

    def doubt(self, now: float, *, offline: bool = False) -> None:
        """Notes that another device may reply from now on. `offline`: it replies to nothing."""
        if offline:
            self._silent_until = -NEVER
        if now >= self._silent_until:
            self.verdict, self.due, self._unanswered = Verdict.UNKNOWN, -NEVER, 0

    def answered(self, told: Mapping[str, Sequence[str]], now: float, pause: float) -> None:
        """Applies a reply. `pause`: seconds until the next question."""
        self._has_told, self._unanswered, self.told = True, 0, told
        others = [name for name, text in self.wanted.items() if text not in told.get(name, ())]
        self.verdict, self.why = Verdict.RIGHT, NO_TROUBLE
        if others:
            self.verdict = Verdict.WRONG
            found = ", ".join(f"{name} {_shown(told.get(name, ()))}" for name in others)
            wanted = ", ".join(f"{name} {self.wanted[name]}" for name in others)
            why = f"Another device replies: it tells {found}; the file says {wanted}"
            self.why = Diagnosis("another-device", why)
        self.due = now + pause

    def refused(self, error: str, now: float) -> None:
        """Applies the refusal of a question."""
        self._unanswered = 0
        if self._has_told:
            self.verdict = Verdict.WRONG
            why = f"Another device replies: it does not tell its identity any more ({error})"
            self.why = Diagnosis("another-device", why)
        else:
            self.verdict = Verdict.UNTOLD
            why = f"It cannot tell its identity ({error}): nothing checks which device it is"
            self.why = Diagnosis("identity-unchecked", why)
        self.due = now + RECHECK

    def unanswered(self, now: float) -> None:
        """Applies a question without a reply. The device replies to others."""
        self._unanswered += 1
        if self._unanswered < SILENT_TRIES:
            self.due = now
        elif self._has_told:
            self.due = now + min(PAUSE * 2 ** (self._unanswered - SILENT_TRIES), RECHECK)
            why = "It is silent about its identity, which it told before"
            self.why = Diagnosis("identity-silent", why)
        else:
            self.verdict, self._silent_until = Verdict.UNTOLD, now + SILENT_FOR
            self.due, self._unanswered = self._silent_until, 0
            why = "It is silent about its identity: nothing checks which device it is"
            self.why = Diagnosis("identity-unchecked", why)

    def later(self, now: float) -> None:
        """Notes that the device was busy: it is asked again soon."""
        self._unanswered, self.due = max(self._unanswered, 1), now + PAUSE


def _shown(texts: Sequence[str]) -> str:
    return " / ".join(texts[:5]) or "nothing"
