"""One plant of 300 tags, written as sheets of several programs."""

import csv
import io
from dataclasses import dataclass

UNITS = ("rpm", "°C", "bar", "%", "m³/h")


@dataclass(frozen=True, slots=True)
class Point:
    """One row; `scale` 0 where the type has none."""

    name: str
    address: str
    type: str
    unit: str
    scale: float
    comment: str
    writable: bool


def points(count: int = 300) -> list[Point]:
    """Returns words, floats, counters and bits of a Vigor PLC."""
    found = []
    for number in range(count):
        kind = ("int16", "float32", "int32", "bool", "uint16")[number % 5]
        address = {"bool": f"M{number}", "int32": f"C{200 + number // 5 % 56}"}.get(kind)
        found.append(
            Point(
                name=f"{kind}-{number:03}",
                address=address or f"D{2 * number}",
                type=kind,
                unit="" if kind == "bool" else UNITS[number % 7 % 5],
                scale=0 if kind == "bool" else (1, 0.1, 0.01, 2.5)[number % 4],
                comment=f'Pumpe {number}; "Süd", Größe {number % 9}',
                writable=number % 10 == 0,
            )
        )
    return found


def english(rows: list[Point]) -> bytes:
    """Returns what English Excel saves as `CSV UTF-8`."""
    table = [["Name", "Address", "Type", "Unit", "Scale", "Comment", "R/W"]]
    for row in rows:
        scale = f"{row.scale:g}" if row.scale else ""
        access = "R/W" if row.writable else "R"
        table.append([row.name, row.address, row.type, row.unit, scale, row.comment, access])
    return _text(table, ",").encode("utf-8-sig")


def german(rows: list[Point]) -> bytes:
    """Returns what German Excel saves as CSV: `;`, decimal commas, Windows letters, a title row,
    columns in another order, IEC types, empty rows and columns at the end."""
    types = {"int16": "INT", "float32": "REAL", "int32": "DINT", "bool": "BOOL", "uint16": "UINT"}
    table = [["Anlage Süd", "", "", "", "", "", "", ""], [""] * 8]
    table.append(["Adresse", "Bezeichner", "Schreiben", "Faktor", "Einheit", "Datentyp"])
    table[-1] += ["Kommentar", "Schrank"]
    for row in rows:
        scale = f"{row.scale:.2f}".replace(".", ",") if row.scale else ""
        access = "JA" if row.writable else "NEIN"
        cells = [row.address, row.name, access, scale, row.unit, types[row.type], row.comment, "A1"]
        table.append(cells)
    return ("sep=;\r\n" + _text([*table, [""] * 8, [""] * 8], ";")).encode("cp1252")


def kepware(rows: list[Point]) -> bytes:
    """Returns the columns of a SCADA server's export: scan rates in ms, ranges for scales."""
    types = {"int16": "Short", "float32": "Float", "int32": "Long", "bool": "Boolean"}
    types["uint16"] = "Word"
    titles = "Tag Name,Address,Data Type,Respect Data Type,Client Access,Scan Rate,Scaling,"
    titles += "Raw Low,Raw High,Scaled Low,Scaled High,Eng Units,Description"
    table = [titles.split(",")]
    for row in rows:
        scaling = ["Linear", "0", "1000", "0", f"{1000 * row.scale:g}"]
        if row.scale in (0, 1):
            scaling = ["None", "", "", "", ""]
        access = "R/W" if row.writable else "RO"
        cells = [row.name, row.address, types[row.type], "1", access, "1000", *scaling]
        table.append([*cells, row.unit, row.comment])
    return _text(table, ",").encode("utf-8")


def device_comments(rows: list[Point]) -> bytes:
    """Returns the device comments of a PLC program: UTF-16 with tabs, no names and no types."""
    table = [["Device Name", "Comment"], *([row.address, row.comment] for row in rows)]
    stream = io.StringIO(newline="")
    csv.writer(stream, delimiter="\t", quoting=csv.QUOTE_ALL).writerows(table)
    return b"\xff\xfe" + stream.getvalue().encode("utf-16-le")


def _text(table: list[list[str]], delimiter: str) -> str:
    stream = io.StringIO(newline="")
    csv.writer(stream, delimiter=delimiter).writerows(table)
    return stream.getvalue()
