"""The data of one served station: what its master may read and write, address by address."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from gateway.errors import BadValue
from gateway.protocols.driver import Span
from gateway.stations.store import NOTHING, Cell, Denied, Why, Written
from gateway.tags import Quality, Sample, Tag

STALE_AFTER = 10.0  # seconds


@dataclass(frozen=True, slots=True, eq=False)
class ServedTag:
    """One value at addresses of the station.

    The master reads the value of `source` (`device/tag`), or a value that is held: clients write
    it. Where the address is inside `accept`, the master writes it.
    """

    tag: Tag
    source: str | None = None
    hold_last: bool = False  # a bad value is answered with the last good one
    retain: bool = False  # a held value survives restarts
    accepted: bool = False  # the master writes it


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """The settings of a served station. `stale_after` in seconds."""

    rows: tuple[ServedTag, ...]
    accept: tuple[Span, ...] = ()  # the addresses that the master may write
    stale_after: float = STALE_AFTER

    def takes(self, area: str, number: int) -> bool:
        """Returns True if the master may write the address."""
        return any(
            area == span.area and span.start <= number < span.start + span.size
            for span in self.accept
        )


class Registers:
    """Reads and writes of the master. Synchronous; a write is done as a whole or not at all.

    A value that the master writes is good from then on, until `expire`.
    """

    def __init__(self, served: Served, sample_of: Callable[[ServedTag], Sample | None]) -> None:
        """`sample_of`: the present sample of a row that the master reads; None: there is none."""
        self.served = served
        self._sample_of = sample_of
        self._cells: dict[Cell, list[ServedTag]] = {}
        for row in served.rows:
            for cell in cells_of(row.tag.span):
                self._cells.setdefault(cell, []).append(row)
        self._accepted = {cell for span in served.accept for cell in cells_of(span)}
        self._written: dict[Cell, int] = {}
        self._good: set[Tag] = set()  # of those that the master writes
        self._last: dict[ServedTag, Sequence[int]] = {}  # the last good units, with `hold_last`

    @property
    def written_tags(self) -> list[Tag]:
        """The tags that the master writes."""
        return [row.tag for row in self.served.rows if row.accepted]

    # The master reads

    def read(self, area: str, start: int, count: int) -> list[int]:
        """Returns the units. Raises `Denied`."""
        known: dict[ServedTag, Sequence[int]] = {}
        return [self._unit((area, number), known) for number in range(start, start + count)]

    def read_points(self, area: str, start: int, count: int) -> list[int]:
        """Returns bits that travel together in one byte or word.

        Those without a tag are 0, if at least one has a tag. Those that the master writes are 0
        until then: to write some bits, it first reads all of their byte. Raises `Denied`.
        """
        cells = [(area, number) for number in range(start, start + count)]
        if not any(map(self._has, cells)):
            raise Denied(Why.NO_TAG)
        known: dict[ServedTag, Sequence[int]] = {}
        return [self._point(cell, known) for cell in cells]

    def _point(self, cell: Cell, known: dict[ServedTag, Sequence[int]]) -> int:
        if cell in self._accepted:
            return self._written.get(cell, 0)
        return self._unit(cell, known) if cell in self._cells else 0

    def _has(self, cell: Cell) -> bool:
        return cell in self._cells or cell in self._accepted

    def _unit(self, cell: Cell, known: dict[ServedTag, Sequence[int]]) -> int:
        rows = self._cells.get(cell)
        if cell in self._accepted:
            for row in rows or ():
                if row.tag not in self._good and not (row.hold_last and cell in self._written):
                    raise Denied(Why.BAD)
            return self._written.get(cell, 0)
        if rows is None:
            raise Denied(Why.NO_TAG)
        unit = 0
        for row in rows:
            if (units := known.get(row)) is None:
                units = known[row] = self._units(row)
            tag = row.tag
            if tag.part is not None:
                unit = tag.part.into(unit, units[0])
            else:
                unit |= units[cell[1] - tag.span.start]
        return unit

    def _units(self, row: ServedTag) -> Sequence[int]:
        units = _encoded(row.tag, self._sample_of(row))
        if units is None:
            if row not in self._last:
                raise Denied(Why.BAD)
            return self._last[row]
        if row.hold_last:
            self._last[row] = units
        return units

    def remember(self, row: ServedTag, sample: Sample) -> None:
        """Keeps a good sample of the source for `hold_last`."""
        if (units := _encoded(row.tag, sample)) is not None:
            self._last[row] = units

    # The master writes

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        """Writes all cells of one request. Returns the tags with their values, by address.

        A master that writes some bits of a byte has read the others before: one of `points`
        outside `accept` is left alone if it is written with the value that the master reads there.
        Raises `Denied`, and then nothing is written: outside `accept`, or for some words of a
        longer value, which would join halves of two values.
        """
        if missing:
            raise Denied(Why.PART)
        new, known = dict(cells), dict[ServedTag, Sequence[int]]()
        for cell, bit in points:
            if cell in self._accepted:
                new[cell] = bit
            elif bit != self._point(cell, known):
                raise Denied(Why.NOT_ACCEPTED)
        touched: dict[ServedTag, None] = {}
        for cell in new:
            if cell not in self._accepted:
                raise Denied(Why.NOT_ACCEPTED)
            touched |= dict.fromkeys(self._cells.get(cell, ()))
        if not new or any(c not in new for row in touched for c in cells_of(row.tag.span)):
            raise Denied(Why.PART)
        self._written |= new
        self._good |= {row.tag for row in touched}
        return [(row.tag, row.tag.decode(self._raw(row.tag))) for row in touched]

    def _raw(self, tag: Tag) -> list[int]:
        return [self._written[cell] for cell in cells_of(tag.span)]

    def expire(self) -> None:
        """Turns all values of the master bad, until it writes them again."""
        self._good.clear()


def cells_of(span: Span) -> list[Cell]:
    return [(span.area, number) for number in range(span.start, span.start + span.size)]


def _encoded(tag: Tag, sample: Sample | None) -> list[int] | None:
    """Returns the units of a good sample, in the type of the tag; None: there are none."""
    if sample is None or sample.quality is not Quality.GOOD or sample.value is None:
        return None
    value = sample.value
    whole = tag.layout.type.is_number and not tag.value_type.startswith("float")
    try:
        if whole and isinstance(value, float):
            value = round(value)
        elif whole and isinstance(value, tuple):
            value = tuple(round(one) if isinstance(one, float) else one for one in value)
        return tag.encode(value)
    except (BadValue, OverflowError, ValueError):
        return None
