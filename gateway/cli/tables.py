"""Tables of values for people."""

import json
from collections.abc import Iterable, Sequence
from datetime import datetime

from rich.table import Table
from rich.text import Text

from gateway.cli.client import TagRow
from gateway.cli.terminal import out, printable
from gateway.tags import Quality, Sample, Tag


def row_of(sample: Sample) -> TagRow:
    """Returns the row of a sample, with the payload that Zenoh would carry."""
    from gateway.contract.payload import sample_fields  # for a command that opens the port

    return TagRow(sample.tag.key, {**sample_fields(sample)})


def is_good(row: TagRow) -> bool:
    return bool(row.document.get("quality") == Quality.GOOD)


def print_rows(
    rows: Sequence[TagRow], tags: dict[str, Tag], *, as_json: bool, utc: bool = False
) -> None:
    """Prints a table with times of this machine's zone unless `utc`. JSON has UTC always."""
    if as_json:
        for row in rows:
            print(json.dumps({"tag": row.tag, **row.document}), flush=True)
    else:
        out.print(table_of(rows, tags, utc=utc))


def table_of(rows: Iterable[TagRow], tags: dict[str, Tag], *, utc: bool = False) -> Table:
    """Returns a table of values, with one line for each row."""
    table = Table(box=None, pad_edge=False)
    for column in ("tag", "value", "unit", "quality", "time"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for row in rows:
        document = row.document
        good, end = is_good(row), document.get("limited")
        quality = "good" if good else f"{document.get('quality')}: {document.get('reason')}"
        if document.get("value") is not None:
            more = [document.get("origin"), f"limited {end}" if end else None]
            quality = ", ".join([quality, *(str(one) for one in more if one)])
        tag = tags.get(row.tag)
        table.add_row(
            Text(row.tag),
            Text("-" if document.get("value") is None else _named(document)),
            Text(tag.label.unit if tag else ""),
            Text(printable(quality), style="" if good else "red"),
            Text(time_text(str(document.get("time", "")), utc=utc)),
        )
    return table


def time_text(text: str, *, utc: bool = False) -> str:
    """Returns a time of a payload in this machine's zone: `2026-11-20T13:00:00.123+01:00`.

    With `utc` as it is in the payload. A text that is no time stays as it is.
    """
    if utc:
        return printable(text)
    try:
        return datetime.fromisoformat(text).astimezone().isoformat(timespec="milliseconds")
    except (ValueError, OverflowError):
        return printable(text)


def _named(document: dict[str, object]) -> str:
    """Returns the value, behind its name if it has one: `auto (1)`."""
    value = value_text(document["value"])
    return printable(f"{document['text']} ({value})") if document.get("text") else value


def value_text(value: object) -> str:
    """Returns a value as JSON and YAML write it, without control characters."""
    if isinstance(value, bool):
        return {True: "true", False: "false"}[value]
    if isinstance(value, (list, tuple)):
        return printable(json.dumps(value))
    return printable(str(value))
