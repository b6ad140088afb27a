"""The data of a simulated Modbus slave: wire addresses in front, the PLC's own memory behind.

Written from the tables of the manuals independent of the driver, to find mistakes of either.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from gateway.stations.station import Memory


class Run(NamedTuple):
    """Wire addresses `wire` .. `wire + size - 1`, and the area they show from unit `first` on."""

    wire: int
    size: int
    area: str
    first: int = 0
    writable: bool = True
    halves: bool = False  # two addresses share one 32-bit unit


class Part(NamedTuple):
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
    *(Run(0x1000 * i, 4096, name, writable=name != "F") for i, name in enumerate(_RELAYS)),
    Run(5 * 0x1000, 256, "TS"),
    Run(6 * 0x1000, 256, "CS"),
)
_K120S_WORDS = (
    *(Run(0x1000 * i, 256, f"{name}W", writable=name != "F") for i, name in enumerate(_RELAYS)),
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


def parts_of(runs: Runs, wire: int, count: int) -> Iterator[Part]:
    """Yields the pieces of the addresses that exist, in order."""
    for run in sorted(runs):
        start, end = max(wire, run.wire), min(wire + count, run.wire + run.size)
        if start < end:
            yield Part(run, start - run.wire, end - start)


class Store:
    """A slave's memory, reached by function code and wire address."""

    def __init__(
        self, dialect: str, holes: Sequence[tuple[str, int, int]], *, low_first: bool
    ) -> None:
        """`holes`: (area, first, last) that this device lacks."""
        served = _SERVED[dialect]
        self._runs = runs_by_function(dialect)
        self._holes = holes
        self._low_first = low_first
        self._agreed: dict[tuple[str, int], int] = {}  # relay words, as both views last had them
        self._relays = frozenset(_RELAYS) if dialect == "k120s" else frozenset()
        areas = {run.area: run for runs in served.values() for run in runs}
        self.memory = Memory(
            (run.area, run.first, run.first + run.size // (2 if run.halves else 1) - 1)
            for run in areas.values()
        )

    def serves(self, function: int) -> bool:
        return function in self._runs

    def holds(self, function: int, wire: int, count: int) -> bool:
        """Returns True when the addresses exist and, for a write, are writable."""
        parts = list(self._parts(function, wire, count))
        return (
            sum(part.size for part in parts) == count
            and (function not in _WRITES or all(part.run.writable for part in parts))
            and not any(self._in_hole(part) for part in parts)
        )

    def read(self, function: int, wire: int, count: int, now: float) -> list[int]:
        values: list[int] = []
        for part in self._parts(function, wire, count):
            first, size = _units(part)
            self._reconcile(part, now)
            units = self.memory.read(part.run.area, first, size, now)
            values += (
                self._halved(units)[part.ahead % 2 :][: part.size] if part.run.halves else units
            )
        return values

    def write(self, function: int, wire: int, values: Sequence[int], now: float) -> None:
        done = 0
        for part in self._parts(function, wire, len(values)):
            piece = values[done : done + part.size]
            done += part.size
            first, size = _units(part)
            self._reconcile(part, now)
            if part.run.halves:
                words = self._halved(self.memory.read(part.run.area, first, size, now))
                ahead = part.ahead % 2
                words[ahead : ahead + part.size] = piece
                piece = self._joined(words)
            self.memory.write(part.run.area, first, piece)
            self._reconcile(part, now)

    def _parts(self, function: int, wire: int, count: int) -> Iterator[Part]:
        """Yields the pieces of the range that exist, in order."""
        yield from parts_of(self._runs[function], wire, count)

    def _in_hole(self, part: Part) -> bool:
        first, size = _units(part)
        guard = self.memory.guard
        if guard is not None and guard(part.run.area, range(first, first + size)):
            return True
        return any(
            area == part.run.area and first <= end and start < first + size
            for area, start, end in self._holes
        )

    def _halved(self, units: Sequence[int]) -> list[int]:
        pairs = ((unit & 0xFFFF, unit >> 16 & 0xFFFF) for unit in units)
        return [
            word
            for low, high in pairs
            for word in ((low, high) if self._low_first else (high, low))
        ]

    def _joined(self, words: Sequence[int]) -> list[int]:
        low, high = (0, 1) if self._low_first else (1, 0)
        return [a | b << 16 for a, b in zip(words[low::2], words[high::2], strict=True)]

    def _reconcile(self, part: Part, now: float) -> None:
        """Copies changes between the words and the bits of K120S relays."""
        letter = part.run.area[0]
        if letter not in self._relays or part.run.area not in (letter, f"{letter}W"):
            return
        step = 16 if part.run.area == letter else 1
        for word in range(part.ahead // step, (part.ahead + part.size - 1) // step + 1):
            bits = self.memory.read(letter, word * 16, 16, now)
            packed = sum(bit << i for i, bit in enumerate(bits))
            value = self.memory.read(f"{letter}W", word, 1, now)[0]
            agreed = self._agreed.get((letter, word), 0)
            if packed != agreed:
                self.memory.write(f"{letter}W", word, [packed])
                self._agreed[letter, word] = packed
            elif value != agreed:
                self.memory.write(letter, word * 16, [value >> i & 1 for i in range(16)])
                self._agreed[letter, word] = value


def _units(part: Part) -> tuple[int, int]:
    """Returns first unit and number of units of a part."""
    if not part.run.halves:
        return part.run.first + part.ahead, part.size
    first, last = part.ahead // 2, (part.ahead + part.size - 1) // 2
    return part.run.first + first, last - first + 1
