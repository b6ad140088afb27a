"""Words of a device in every type and word order, side by side."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from gateway.cli.terminal import printable
from gateway.protocols.driver import Unit
from gateway.values import Kind, Layout, Order, Value, ValueType, from_words

BITS_IN_ROW = 8
# Characters of a terminal for all columns; without uint32; also without bits. Else without text.
WIDE, MEDIUM, NARROW = 140, 116, 92
_SPARE = 6  # characters that are left for notes in the narrowest table
CHANGED = "bold reverse"
_WIDTHS = {"hex": 4, "bits 15..0": 19, "uint16": 6, "int16": 6, "text": 4}
_LOW, _HIGH = Order.LOW_FIRST, Order.HIGH_FIRST
_PLAUSIBLE = (1e-4, 1e8)  # amounts of floats that a process has


class Cell(NamedTuple):
    """The newest value at one address. `note`: the reason where it is not known, or its tag."""

    address: str
    raw: int | None
    changed: bool = False
    note: str = ""


class Column(NamedTuple):
    title: str
    words: int
    show: Callable[[Sequence[int]], str]


def table_of(cells: Sequence[Cell], unit: Unit, text_order: Order, width: int) -> Table:
    """Returns the table for a terminal of `width` characters."""
    if unit is Unit.BIT:
        return _bits(cells)
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    columns = columns_of(unit, text_order, width)
    table.add_column("address", no_wrap=True)
    for column in columns:
        table.add_column(column.title, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    room = max(_SPARE, width - 9 - sum(_WIDTHS.get(column.title, 13) + 1 for column in columns))
    for number, cell in enumerate(cells):
        row = [
            _styled(shown_in(column, cells, number), cell, column.title == "hex")
            for column in columns
        ]
        mark = "* " if cell.changed else ""
        table.add_row(Text(cell.address), *row, Text((mark + printable(cell.note))[:room]))
    return table


def shown_in(column: Column, cells: Sequence[Cell], number: int) -> str:
    """Returns the text of a cell in a column; `-` without all the words that it needs."""
    raws = [cell.raw for cell in cells[number : number + column.words]]
    words = [raw for raw in raws if raw is not None]
    return column.show(words) if len(words) == column.words else "-"


def _styled(shown: str, cell: Cell, is_hex: bool) -> Text:
    style = CHANGED if cell.changed and is_hex else ""
    return Text(shown, style="dim" if shown == "-" or shown.endswith("?") else style)


def columns_of(unit: Unit, text_order: Order, width: int) -> list[Column]:
    """Returns the columns of words that `width` characters have room for."""
    if unit is Unit.DWORD:
        halves = _halves
        return [
            Column("hex", 1, lambda words: f"{words[0]:08X}"),
            Column("uint32", 1, lambda words: str(words[0])),
            Column("int32", 1, halves(Kind.INT32)),
            Column("float32", 1, halves(Kind.FLOAT32)),
        ]
    columns = [Column("hex", 1, lambda words: f"{words[0]:04X}")]
    if width >= MEDIUM:
        columns.append(Column("bits 15..0", 1, _binary))
    columns += [
        Column("uint16", 1, lambda words: str(words[0])),
        Column("int16", 1, _as(Kind.INT16, _LOW)),
    ]
    if width >= NARROW:
        columns.append(Column("text", 1, lambda words: _letters(words[0], text_order)))
    for order, title in ((_LOW, "low"), (_HIGH, "high")):
        if width >= WIDE:
            columns.append(Column(f"{title} uint32", 2, _as(Kind.UINT32, order)))
        columns += [
            Column(f"{title} int32", 2, _as(Kind.INT32, order)),
            Column(f"{title} float32", 2, _as(Kind.FLOAT32, order)),
        ]
    return columns


def _as(kind: Kind, order: Order) -> Callable[[Sequence[int]], str]:
    decode = from_words(Layout(ValueType(kind), order))
    return lambda words: number_text(decode(words))


def _halves(kind: Kind) -> Callable[[Sequence[int]], str]:
    decode = from_words(Layout(ValueType(kind), _LOW))
    return lambda words: number_text(decode([words[0] & 0xFFFF, words[0] >> 16]))


def number_text(value: Value | None) -> str:
    """Returns a number; a float that no process has gets a question mark behind it."""
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    least, most = _PLAUSIBLE
    doubtful = value != 0 and not least <= abs(value) < most
    return f"{value:.3g}?" if doubtful else f"{value:.7g}"


def _binary(words: Sequence[int]) -> str:
    digits = f"{words[0]:016b}"
    return " ".join(digits[at : at + 4] for at in range(0, 16, 4))


def _letters(word: int, order: Order) -> str:
    pair = bytes((word >> 8, word & 0xFF) if order is _HIGH else (word & 0xFF, word >> 8))
    return "".join(chr(byte) if 0x20 < byte < 0x7F else "." for byte in pair)


def _bits(cells: Sequence[Cell]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("address")
    for number in range(min(BITS_IN_ROW, len(cells))):
        table.add_column(f"+{number}", justify="right")
    table.add_column("")
    for begin in range(0, len(cells), BITS_IN_ROW):
        row = cells[begin : begin + BITS_IN_ROW]
        shown = [
            Text("-" if cell.raw is None else str(cell.raw), style=CHANGED if cell.changed else "")
            for cell in row
        ]
        shown += [Text()] * (min(BITS_IN_ROW, len(cells)) - len(row))
        notes = [f"{cell.address} {cell.note}" for cell in row if cell.note]
        mark = "* " if any(cell.changed for cell in row) else ""
        table.add_row(Text(row[0].address), *shown, Text(mark + printable(", ".join(notes))))
    return table


def change_text(cell: Cell, before: int | None, unit: Unit) -> str:
    """Returns a change in one line, for output that is no terminal."""
    digits = {Unit.BIT: 1, Unit.WORD: 4, Unit.DWORD: 8}[unit]

    def spoken(raw: int | None) -> str:
        return cell.note or "-" if raw is None else f"{raw} (0x{raw:0{digits}X})"

    return f"{cell.address}: {'' if before is None else f'{spoken(before)} -> '}{spoken(cell.raw)}"
