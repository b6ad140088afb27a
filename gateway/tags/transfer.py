"""The rule of a transfer, as the file describes it: which value is written where, and when."""

from dataclasses import dataclass, replace

from gateway.tags.scaling import linear, scaled, scaled_float
from gateway.values import Value


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferRule:
    """One row of the file. `source`, `target`: keys of tags, `device/tag`. Times in seconds."""

    number: int  # of the row, from 1
    source: str
    target: str
    text: tuple[str, str]  # source and target as the file writes them
    every: float | None = None  # None: each change is carried once
    scale: float = 1.0
    offset: float = 0.0
    stale: float = 5.0  # an older read is not carried
    substitute: Value | None = None  # written once when the source is too old; None: nothing is

    @property
    def when(self) -> str:
        """`on change`, or the interval."""
        return "on change" if self.every is None else f"every {self.every:g} s"

    def says_same(self, other: "TransferRule") -> bool:
        """True if both carry the same in the same way; the number may be another one."""
        return replace(self, number=other.number) == other

    def value(self, known: Value, *, whole: bool) -> Value | None:
        """Returns the value for the target; None beyond the range of numbers.

        `whole`: the target takes whole numbers only, so that the value is rounded.
        """
        if isinstance(known, (bool, str)):
            return known
        line = linear(self.scale, self.offset)
        carried: float | None = known
        if line is not None:
            carried = (scaled_float if isinstance(known, float) else scaled)(line)(known)  # type: ignore[arg-type]  # as the value is
        return round(carried) if whole and carried is not None else carried
