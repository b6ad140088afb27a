"""The contract of a simulated PLC, and its memory."""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from itertools import chain
from typing import Protocol

from gateway.stations.store import NOTHING, Cell, Denied, Why, Written

# Gets an area and numbers in it that a request names. Returns True where the PLC lacks them.
Guard = Callable[[str, Sequence[int]], bool]


class Memory:
    """The device memory of a PLC by area name; index = number - first number of the area.

    `animate` makes a cell a function of time, until it is written. Where there is a `guard`, the
    station asks it before it carries out a request.
    """

    def __init__(self, areas: Iterable[tuple[str, int, int]], holes: Iterable[Cell] = ()) -> None:
        """`areas`: (name, first number, last number). `holes`: cells that this model lacks."""
        self.guard: Guard | None = None
        self.holes = set(holes)
        self._first: dict[str, int] = {}
        self._size: dict[str, int] = {}
        self._cells: dict[str, list[int]] = {}  # up to the last one that was written
        self._moving: dict[str, dict[int, Callable[[float], int]]] = {}
        for name, first, last in areas:
            self._first[name] = first
            self._size[name] = last - first + 1
            self._cells[name] = []

    def holds(self, area: str, start: int, count: int = 1) -> bool:
        """Returns True when the whole range exists."""
        if area not in self._cells or count < 1:
            return False
        offset = start - self._first[area]
        return offset >= 0 and offset + count <= self._size[area]

    def read(self, area: str, start: int, count: int = 1, now: float = 0.0) -> list[int]:
        """Returns the units `start` .. `start + count - 1` at the time `now`."""
        offset = start - self._first[area]
        values = self._cells[area][offset : offset + count]
        if len(values) < count:
            values += [0] * (min(count, self._size[area] - offset) - len(values))
        if moving := self._moving.get(area):
            for i in range(count):
                motion = moving.get(start + i)
                if motion is not None:
                    values[i] = motion(now)
        return values

    def write(self, area: str, start: int, values: Iterable[int]) -> None:
        """Writes the units from `start` on. Raises `IndexError` beyond the area."""
        cells, offset, units = self._cells[area], start - self._first[area], list(values)
        end = offset + len(units)
        if not 0 <= offset <= end <= self._size[area]:
            raise IndexError(f"{len(units)} units from {area}{start} on")
        cells += [0] * (end - len(cells))
        cells[offset:end] = units
        if moving := self._moving.get(area):
            for i in range(start, start + len(units)):
                moving.pop(i, None)

    def animate(self, area: str, index: int, motion: Callable[[float], int]) -> None:
        """Makes the unit `motion(now)`, until it is written."""
        self._moving.setdefault(area, {})[index] = motion


class MemoryStore:
    """The memory of a simulated PLC, as its protocol reaches it at the time `now`."""

    def __init__(self, memory: Memory, read_only: Container[str] = ()) -> None:
        """`read_only`: areas that no request writes."""
        self.memory = memory
        self.now = 0.0
        self._read_only = read_only

    def _check(self, area: str, start: int, count: int) -> None:
        memory, numbers = self.memory, range(start, start + count)
        lacks = not memory.holds(area, start, count)
        if not lacks and memory.holes:
            lacks = any((area, number) in memory.holes for number in numbers)
        if lacks or (memory.guard is not None and memory.guard(area, numbers)):
            raise Denied(Why.NO_TAG)

    def read(self, area: str, start: int, count: int) -> list[int]:
        self._check(area, start, count)
        return self.memory.read(area, start, count, self.now)

    read_points = read

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        runs: list[tuple[Cell, list[int]]] = []
        for (area, number), unit in chain(cells, points):
            if runs and runs[-1][0] == (area, number - len(runs[-1][1])):
                runs[-1][1].append(unit)
            else:
                runs.append(((area, number), [unit]))
        for (area, number), units in runs:
            if area in self._read_only:
                raise Denied(Why.NOT_ACCEPTED)
            self._check(area, number, len(units))
        for (area, number), units in runs:
            for i in range(len(units)) if missing else ():
                if kept := missing.get((area, number + i), 0):
                    units[i] |= kept & self.memory.read(area, number + i, 1, self.now)[0]
            self.memory.write(area, number, units)
        return ()


class Station(Protocol):
    """A simulated PLC: bytes in, whole frames out."""

    @property
    def memory(self) -> Memory: ...

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the frames to send after `data`, any piece of the bytes on the line."""
