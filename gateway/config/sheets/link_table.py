"""Communication tables of a Vigor PLC that was the master of a line, as sheets of tags.

The PLC copied with the instruction LINK (Vigor VB/VH manual, B-3-3) or MBUS (B-3-6). Its table says
which data of which station it read and wrote: the gateway in its place needs the same tags. Two
forms are known: the table of Ladder Master (Command, Master Data, Slave ID, Slave Data, Length),
and the registers themselves (Register, Value), 7 for each row from the second on.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from gateway.config.sheets.grid import HEADER_ROWS, Grid, Row
from gateway.errors import ConfigError

_MOST = 64  # words or bits of a row
_ROW = 7  # registers
_DEVICE = re.compile(r"([A-Z]+)([0-9]+)\Z")
_OCTAL = ("X", "Y")
# Device types of LINK, and of the master in MBUS; those from 10 on are words.
_LINK = dict(enumerate(("X", "Y", "M", "S", "TS", "CS"), 1))
_LINK |= dict(enumerate(("T", "C", "C", "D"), 10))
_MBUS = {0: "coil:", 1: "discrete:", 3: "input:", 4: "holding:"}
_BITS = {*list(_LINK.values())[:6], "coil", "discrete"}
_SINGLE = ("single write", "3")  # of MBUS: one word or bit, whatever the length says
_COMMANDS = {"read": "r", "write": "rw", "1": "r", "2": "rw", **dict.fromkeys(_SINGLE, "rw")}
_TITLES = ["Name", "Address", "R/W", "Comment"]
_USE_LADDER_MASTER = "use the table of Ladder Master"
# From an address in a Modbus table, such as holding:0, to the name that the device has for it.
Native = Callable[[str], str]


class _Copy(NamedTuple):
    """One row: `slave` is the first address at the station."""

    row: int  # of the sheet
    command: str  # as in `_COMMANDS`
    station: int
    slave: str
    length: int
    master: str


def is_table(grid: Grid) -> bool:
    """Returns True for a communication table."""
    return _layout(grid.rows) is not None


def stations_in(grid: Grid) -> list[int]:
    """Returns the stations of a table, in their order; none for another sheet.

    Raises `ConfigError`.
    """
    return list(dict.fromkeys(copy.station for copy in _copies(grid.rows)))


def of_station(grid: Grid, station: int, native: Native = str) -> Grid:
    """Returns the data of one station as a sheet of tags. Raises `ConfigError`."""
    copies = [copy for copy in _copies(grid.rows) if copy.station == station]
    if not copies:
        known = ", ".join(map(str, stations_in(grid)))
        raise ConfigError(f"the table has no row for station {station}: it has {known}")
    rows = [Row(1, _TITLES)]
    seen: dict[str, str] = {}
    for copy in sorted(copies, key=lambda copy: copy.command, reverse=True):  # written ones first
        for address in map(native, _addresses(copy, copy.slave)):
            if address not in seen:
                seen[address] = copy.command
                name = address.replace(":", "-").lower()
                comment = f"{copy.master} of the master PLC, row {copy.row} of its table"
                rows.append(Row(copy.row, [name, address, copy.command, comment]))
    return Grid(rows, ".")


class Transferred(NamedTuple):
    """One row as ranges: `reads` from the station to the master, or writes the other way."""

    row: int  # of the sheet
    station: int
    slave: str
    master: str
    reads: bool


def transfers_in(grid: Grid, native: Callable[[int, str], str]) -> list[Transferred]:
    """Returns the rows of a table; none for another sheet. Raises `ConfigError`.

    `native`: as `Native`, with the station before the address.
    """
    found = []
    for copy in _copies(grid.rows):
        slave = _range([native(copy.station, one) for one in _addresses(copy, copy.slave)])
        master = _range([*_addresses(copy, copy.master)])
        found.append(Transferred(copy.row, copy.station, slave, master, copy.command == "r"))
    return found


def _range(addresses: Sequence[str]) -> str:
    first, *rest = addresses
    return f"{first}..{rest[-1]}" if rest else first


def _layout(rows: Sequence[Row]) -> tuple[int, dict[str, int]] | None:
    """Returns the index of the titles, and the column of each; None for another sheet."""
    for index, row in enumerate(rows[:HEADER_ROWS]):
        columns = {" ".join(cell.casefold().split()): at for at, cell in enumerate(row.cells)}
        if columns.keys() >= {"command", "master data", "slave id", "length"}:
            return index, columns
        if set(columns) == {"register", "value"}:
            return index, columns
    return None


def _copies(rows: Sequence[Row]) -> Iterator[_Copy]:
    layout = _layout(rows)
    if layout is None:
        return
    index, columns = layout
    rest = [row for row in rows[index + 1 :] if row.cells]
    if "register" in columns:
        yield from _registers(rest, columns)
        return
    for row in rest:
        cells = {
            title: row.cells[at] if at < len(row.cells) else "" for title, at in columns.items()
        }
        command = _COMMANDS.get(cells["command"].casefold())
        if command is None:
            raise ConfigError(f"row {row.number}: {cells['command']!r} is neither Read nor Write")
        is_bit = (cells.get("word/bit") or cells.get("word / bit", "")).upper() == "B"
        slave, master = _state(cells.get("slave data", ""), is_bit), cells["master data"]
        if not slave:  # MBUS has a type and a number
            kind = _number(row, cells.get("slave data type", ""))
            slave = f"{_named(row, kind, _MBUS)}{_number(row, cells.get('slave data #', ''))}"
        single = cells["command"].casefold() in _SINGLE
        length = 1 if single else _number(row, cells["length"])
        station = _number(row, cells["slave id"])
        yield _checked(_Copy(row.number, command, station, slave, length, _state(master, is_bit)))


def _state(text: str, is_bit: bool) -> str:
    """Returns the contact of a timer or a counter, where the row is one of bits."""
    return re.sub(r"\A([TC])(?=[0-9])", r"\1S", text.upper()) if is_bit else text


def _registers(rows: Sequence[Row], columns: dict[str, int]) -> Iterator[_Copy]:
    """The first register is the number of rows, then come 7 registers for each."""
    registers = [row.cells[columns["register"]] for row in rows]
    values = [_number(row, row.cells[columns["value"]]) for row in rows]
    first = _DEVICE.match(registers[0].upper()) if registers else None
    if first is None or first[1] != "D":
        raise ConfigError("the registers of a table are D1000, D1001 ... in a row")
    wanted = [f"D{int(first[2]) + place}" for place in range(len(rows))]
    for row, have, want in zip(rows, registers, wanted, strict=True):
        if have.upper() != want:
            raise ConfigError(f"row {row.number}: {want} is missing, there is {have}")
    if len(values) < 1 + _ROW * values[0]:
        raise ConfigError(
            f"{registers[0]} says {values[0]} rows of {_ROW} registers; there are {len(values) - 1}"
        )
    starts = range(1, 1 + _ROW * values[0], _ROW)
    kinds = _kinds([(rows[start], values[start : start + _ROW]) for start in starts])
    for start in starts:
        row = rows[start]
        station, code, length, kind, own, slave_kind, slave = values[start : start + _ROW]
        target = _spelt(_named(row, slave_kind, kinds), slave)
        length = 1 if str(code) in _SINGLE else length
        master = _spelt(_named(row, kind, _LINK), own)
        yield _checked(_Copy(row.number, _COMMANDS[str(code)], station, target, length, master))


def _spelt(kind: str, number: int) -> str:
    return f"{kind} no. {number}" if kind in _OCTAL else f"{kind}{number}"


def _kinds(rows: Sequence[tuple[Row, Sequence[int]]]) -> dict[int, str]:
    """Returns the device types of the stations, `_LINK` or `_MBUS`.

    Types 1, 3 and 4 are in both: a row copies bits to bits and words to words, so the device of
    the master decides.
    """
    link, mbus = [], []
    for row, (_, code, _, own, _, slave, _) in rows:
        if str(code) not in _COMMANDS:
            raise ConfigError(f"row {row.number}: {code} is no command: 1, 2 or 3")
        _named(row, own, _LINK)
        of_words = own >= 10
        link.append(slave in _LINK and (slave >= 10) == of_words and code != 3)
        mbus.append(slave in _MBUS and (slave >= 3) == of_words and (code == 1 or slave in (0, 4)))
        if not (link[-1] or mbus[-1]):
            _named(row, slave, _LINK | _MBUS)
            raise ConfigError(
                f"row {row.number}: the PLC refuses device type {slave} of the station with type "
                f"{own} of the master for command {code}: bits go to bits, words to words"
            )
    if all(link) and all(mbus):
        raise ConfigError(f"the registers may be of LINK or of MBUS: {_USE_LADDER_MASTER}")
    if not (all(link) or all(mbus)):
        odd = rows[link.index(False) if link[0] else mbus.index(False)][0].number
        raise ConfigError(f"row {odd}: one instruction cannot have this row and the first one")
    return _LINK if all(link) else _MBUS


def _checked(copy: _Copy) -> _Copy:
    if not 1 <= copy.length <= _MOST:
        raise ConfigError(f"row {copy.row}: length {copy.length} is not 1 to {_MOST}")
    ends = {_kind_of(text) in _BITS for text in (copy.slave, copy.master) if _kind_of(text)}
    if len(ends) > 1:
        raise ConfigError(
            f"row {copy.row}: {copy.slave} and {copy.master} are a bit and a word: the PLC copies "
            "bits to bits, words to words"
        )
    return copy


def _kind_of(text: str) -> str:
    """`D` of D10, `holding` of holding:0; nothing of what is no address."""
    match = re.match(r"([A-Za-z]+)[ :]?", text)
    return "" if match is None else match[1] if ":" in text else match[1].upper()


def _addresses(copy: _Copy, text: str) -> Iterator[str]:
    """Yields each address of a row from `text` on. X and Y are counted in octal."""
    kind, colon, number = text.partition(":")
    if colon:
        first = int(number)
        yield from (f"{kind}:{address}" for address in range(first, first + copy.length))
        return
    if " no. " in text:
        raise ConfigError(
            f"row {copy.row}: the manual does not say if {text[0]} is counted in octal "
            f"here: {_USE_LADDER_MASTER}"
        )
    match = _DEVICE.match(text.upper())
    if match is None:
        raise ConfigError(f"row {copy.row}: {text!r} is no address such as D10")
    octal = match[1] in _OCTAL
    if octal and set(match[2]) & {"8", "9"}:
        raise ConfigError(f"row {copy.row}: {text} has no octal number")
    first = int(match[2], 8 if octal else 10)
    for address in range(first, first + copy.length):
        yield f"{match[1]}{address:o}" if octal else f"{match[1]}{address}"


def _named(row: Row, kind: int, kinds: dict[int, str]) -> str:
    if kind not in kinds:
        known = ", ".join(map(str, kinds))
        raise ConfigError(f"row {row.number}: {kind} is no device type: {known}")
    return kinds[kind]


def _number(row: Row, text: str) -> int:
    digits = text.upper().removeprefix("K")
    if not digits.isascii() or not digits.isdigit() or len(digits) > 5:
        raise ConfigError(f"row {row.number}: {text!r} is no number")
    return int(digits)
