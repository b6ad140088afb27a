"""The contract of a simulated PLC, and its memory."""

from collections.abc import Callable, Iterable
from typing import Protocol


class Memory:
    """The device memory of a PLC by area name; index = number - first number of the area.

    `animate` makes a cell a function of time, until it is written.
    """

    def __init__(self, areas: Iterable[tuple[str, int, int]]) -> None:
        """`areas`: (name, first number, last number)."""
        self._first: dict[str, int] = {}
        self._cells: dict[str, list[int]] = {}
        self._moving: dict[tuple[str, int], Callable[[float], int]] = {}
        for name, first, last in areas:
            self._first[name] = first
            self._cells[name] = [0] * (last - first + 1)

    def holds(self, area: str, start: int, count: int = 1) -> bool:
        """Returns True when the whole range exists."""
        if area not in self._cells or count < 1:
            return False
        offset = start - self._first[area]
        return offset >= 0 and offset + count <= len(self._cells[area])

    def read(self, area: str, start: int, count: int = 1, now: float = 0.0) -> list[int]:
        """Returns the units `start` .. `start + count - 1` at the time `now`."""
        offset = start - self._first[area]
        values = self._cells[area][offset : offset + count]
        if self._moving:
            for i in range(count):
                motion = self._moving.get((area, start + i))
                if motion is not None:
                    values[i] = motion(now)
        return values

    def write(self, area: str, start: int, values: Iterable[int]) -> None:
        for i, value in enumerate(values):
            self._cells[area][start - self._first[area] + i] = value
            self._moving.pop((area, start + i), None)

    def animate(self, area: str, index: int, motion: Callable[[float], int]) -> None:
        """Makes the unit `motion(now)`, until it is written."""
        self._moving[area, index] = motion


class Station(Protocol):
    """A simulated PLC: bytes in, whole frames out."""

    @property
    def memory(self) -> Memory: ...

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the frames to send after `data`, any piece of the bytes on the line."""
