"""The rule of a transfer, as the file describes it: which value is written where, and when."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from gateway.tags.scaling import linear, scaled, scaled_float
from gateway.tags.tag import Tag
from gateway.values import Value
from gateway.values.numerals import Scalar


def leaves(tag: Tag) -> Iterator[Tag]:
    """Yields the tags with addresses that a value comes from: itself, or its inputs."""
    if not tag.origin.inputs:
        yield tag
    for one in tag.origin.inputs:
        yield from leaves(one)


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
    read_every: float = 0.0  # the interval of the source; 0: no poll reads it

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
        if not isinstance(known, tuple):
            return self._one(known, whole=whole)
        found = [self._one(one, whole=whole) for one in known]
        values = tuple(one for one in found if one is not None)
        return values if len(values) == len(found) else None

    def _one(self, known: Scalar, *, whole: bool) -> Scalar | None:
        if isinstance(known, (bool, str)):
            return known
        line, carried = linear(self.scale, self.offset), known
        if line is not None:
            to = scaled_float(line) if isinstance(known, float) else scaled(line)
            found = to(known)  # type: ignore[arg-type]  # whole numbers are whole
            if found is None:
                return None
            carried = found
        return round(carried) if whole else carried
