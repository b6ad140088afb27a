"""The addresses of Modbus slaves: wire addresses in front, the PLC's own areas behind.

Written from the tables of the manuals independent of the driver, to find mistakes of either.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from gateway.stations.station import Memory, MemoryStore
from gateway.stations.store import NOTHING, Cell, Written


class Run(NamedTuple):
    """Wire addresses `wire` .. `wire + size - 1`, and the area they show from unit `first` on."""

    wire: int
    size: int
    area: str
    first: int = 0
    halves: bool = False  # two addresses share one 32-bit unit


class RunPiece(NamedTuple):
    """The piece of a request that lies in one run: `size` addresses from its `ahead`th on."""

    run: Run
    ahead: int
    size: int


Runs = tuple[Run, ...]

_VIGOR_COILS = (
    Run(0, 512, "Y"),
    Run(512, 5120, "M"),
    Run(5632, 1000, "S"),
    Run(6656, 256, "TS"),
    Run(6912, 256, "CS"),
    Run(7424, 256, "M9", 9000),
)
_VIGOR_REGISTERS = (
    Run(0, 8192, "D"),
    Run(8192, 256, "T"),
    Run(8448, 200, "C"),
    Run(8648, 112, "C32", 200, halves=True),
    Run(8760, 256, "D9", 9000),
)
_RELAYS = "PMLKF"
_K120S_BITS = (
    *(Run(0x1000 * i, 4096, name) for i, name in enumerate(_RELAYS)),
    Run(5 * 0x1000, 256, "TS"),
    Run(6 * 0x1000, 256, "CS"),
)
_K120S_WORDS = (
    *(Run(0x1000 * i, 256, f"{name}W") for i, name in enumerate(_RELAYS)),
    Run(5 * 0x1000, 256, "T"),
    Run(6 * 0x1000, 256, "C"),
    Run(7 * 0x1000, 100, "S"),
    Run(8 * 0x1000, 5000, "D"),
)

# Dialect -> function code -> its data. Other functions are not served.
_SERVED: dict[str, dict[int, Runs]] = {
    "plain": {
        1: (Run(0, 65536, "coil"),),
        2: (Run(0, 65536, "discrete"),),
        3: (Run(0, 65536, "holding"),),
        4: (Run(0, 65536, "input"),),
    },
    "vigor": {
        1: _VIGOR_COILS,
        2: (Run(0, 512, "X"),),
        3: _VIGOR_REGISTERS,
        4: _VIGOR_REGISTERS,
    },
    "k120s": {1: _K120S_BITS, 2: _K120S_BITS, 3: _K120S_WORDS, 4: _K120S_WORDS},
    "ex485lnk": {3: (Run(0, 65536, "holding"),), 4: (Run(0, 65536, "holding"),)},
}
_WRITES = {5: 1, 15: 1, 6: 3, 16: 3}  # the writing function, and the one that reads the same


def runs_by_function(dialect: str) -> dict[int, Runs]:
    """Returns the data of each function that a slave of the dialect serves."""
    served = _SERVED[dialect]
    return served | {write: served[read] for write, read in _WRITES.items() if read in served}


def parts_of(runs: Runs, wire: int, count: int) -> Iterator[RunPiece]:
    """Yields the pieces of the addresses that exist, in order."""
    for run in sorted(runs):
        start, end = max(wire, run.wire), min(wire + count, run.wire + run.size)
        if start < end:
            yield RunPiece(run, start - run.wire, end - start)


def memory_of(dialect: str, holes: Iterable[Cell]) -> Memory:
    """Returns the empty memory of a simulated slave. `holes`: cells that it lacks."""
    areas = {run.area: run for runs in _SERVED[dialect].values() for run in runs}
    return Memory(
        (
            (run.area, run.first, run.first + run.size // (2 if run.halves else 1) - 1)
            for run in areas.values()
        ),
        holes,
    )


class K120sStore:
    """The memory of a simulated K120S: its relays are words and bits at once, F is read-only."""

    def __init__(self, memory: Memory) -> None:
        self._inner = MemoryStore(memory, ("F", "FW"))
        self._agreed: dict[Cell, int] = {}  # relay words, as both views last had them

    @property
    def now(self) -> float:
        return self._inner.now

    @now.setter
    def now(self, now: float) -> None:
        self._inner.now = now

    def read(self, area: str, start: int, count: int) -> list[int]:
        self._reconcile(area, start, count)
        return self._inner.read(area, start, count)

    read_points = read

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        places = [cell for cell, _ in cells]
        for place in places:
            self._reconcile(*place, 1)
        written = self._inner.write(cells, points, missing)
        for place in places:
            self._reconcile(*place, 1)
        return written

    def _reconcile(self, area: str, start: int, count: int) -> None:
        """Copies changes between the words and the bits of relays."""
        letter, memory, now = area[0], self._inner.memory, self.now
        if letter not in _RELAYS or area not in (letter, f"{letter}W"):
            return
        step = 16 if area == letter else 1
        for word in range(start // step, (start + count - 1) // step + 1):
            bits = memory.read(letter, word * 16, 16, now)
            packed = sum(bit << i for i, bit in enumerate(bits))
            value = memory.read(f"{letter}W", word, 1, now)[0]
            agreed = self._agreed.get((letter, word), 0)
            if packed != agreed:
                memory.write(f"{letter}W", word, [packed])
                self._agreed[letter, word] = packed
            elif value != agreed:
                memory.write(letter, word * 16, [value >> i & 1 for i in range(16)])
                self._agreed[letter, word] = value
