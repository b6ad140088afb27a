"""The contract of a simulated PLC, and its memory."""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

# Gets an area and numbers in it that a request names. Returns True where the PLC lacks them.
Guard = Callable[[str, Sequence[int]], bool]


class Memory:
    """The device memory of a PLC by area name; index = number - first number of the area.

    `animate` makes a cell a function of time, until it is written. Where there is a `guard`, the
    station asks it before it carries out a request.
    """

    def __init__(self, areas: Iterable[tuple[str, int, int]]) -> None:
        """`areas`: (name, first number, last number)."""
        self.guard: Guard | None = None
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


class Station(Protocol):
    """A simulated PLC: bytes in, whole frames out."""

    @property
    def memory(self) -> Memory: ...

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the frames to send after `data`, any piece of the bytes on the line."""
