"""The data of a device for the answering machine of a door, in two passes.

A machine answers at once, but the device is asked over the wire. So a request is heard twice, by
two machines that were given the same bytes: the first notes in `Needs` what the request needs of
the device. When that is done, the second answers from `Outcomes`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from gateway.protocols.driver import Span
from gateway.stations.store import NOTHING, Cell, Denied, Rejected, Why, Written


@dataclass(slots=True)
class Step:
    """Addresses of one device that a request reads or writes. `cells`: with the units to write."""

    device: str
    writes: bool
    cells: dict[Cell, int] = field(default_factory=dict)

    def runs(self) -> Iterator[Span]:
        """Yields the addresses as neighbours."""
        first: Cell | None = None
        last = ("", 0)
        for cell in sorted(self.cells):
            if first is not None and cell != (last[0], last[1] + 1):
                yield Span(first[0], first[1], last[1] - first[1] + 1)
                first = None
            first, last = first or cell, cell
        if first is not None:
            yield Span(first[0], first[1], last[1] - first[1] + 1)

    def units(self, run: Span) -> list[int]:
        return [self.cells[run.area, run.start + ahead] for ahead in range(run.size)]


@dataclass(slots=True)
class Needs:
    """Notes what requests need of one device, and answers anything. A `Store`."""

    device: str
    steps: list[Step]  # of all devices of the door, in the order of the requests

    def read(self, area: str, start: int, count: int) -> list[int]:
        self._step(writes=False).cells |= {(area, start + ahead): 0 for ahead in range(count)}
        return [0] * count

    read_points = read

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        if missing:
            raise Denied(Why.PART)
        self._step(writes=True).cells |= dict([*cells, *points])
        return ()

    def _step(self, *, writes: bool) -> Step:
        last = self.steps[-1] if self.steps else None
        if last is None or (last.device, last.writes) != (self.device, writes):
            last = Step(self.device, writes)
            self.steps.append(last)
        return last


@dataclass(slots=True)
class Outcomes:
    """A `Store` with the results of the steps of one device."""

    _read: dict[Cell, int | Denied | Rejected] = field(default_factory=dict)
    _written: dict[Cell, Denied | Rejected | None] = field(default_factory=dict)

    def note(self, step: Step, outcome: Mapping[Cell, int] | Denied | Rejected) -> None:
        """Notes the units that a step read or wrote, or why it was not done."""
        failed = outcome if isinstance(outcome, Denied | Rejected) else None
        if step.writes:
            self._written |= dict.fromkeys(step.cells, failed)
        elif failed is not None:
            self._read |= dict.fromkeys(step.cells, failed)
        elif isinstance(outcome, Mapping):
            self._read |= outcome

    def forget(self) -> None:
        self._read.clear()
        self._written.clear()

    def read(self, area: str, start: int, count: int) -> list[int]:
        units = list[int]()
        for number in range(start, start + count):
            unit = self._read.get((area, number))
            if not isinstance(unit, int):
                raise unit or Denied(Why.BAD)
            units.append(unit)
        return units

    read_points = read

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        if missing:
            raise Denied(Why.PART)
        for cell, _ in (*cells, *points):
            failed = self._written.get(cell, Denied(Why.NOT_ACCEPTED))
            if failed is not None:
                raise failed
        return ()
