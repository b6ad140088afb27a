"""The `archive` commands: the histories of many gateways in one store, and how far they are."""

import json
import time
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from gateway.archive.archiver import archive
from gateway.archive.rows import rfc3339
from gateway.archive.store import Cursor
from gateway.archive.stores import store_at
from gateway.bridges.program import Gateways
from gateway.bridges.program import run as run_program
from gateway.cli.terminal import ROUTER, AsJson, ZenohFile, out, printable
from gateway.contract.line_faults import span
from gateway.errors import GatewayError

cli = typer.Typer(help="The histories of many gateways in one store.", no_args_is_help=True)

MOST_AHEAD = 60.0  # seconds of the archiver's clock before that of this machine
_ROUTERS = [ROUTER]  # typer copies it
_PLACE = "A folder, s3://bucket/folder, postgresql://user@host/database, or an address of InfluxDB."
Place = Annotated[str, typer.Argument(metavar="STORE", help=_PLACE)]


@cli.callback()
def commands() -> None:
    """The histories of many gateways in one store."""


@cli.command()
def run(
    store: Place,
    connect: Annotated[
        list[str], typer.Option(metavar="ENDPOINT", help="A gateway or a router; several: spare.")
    ] = _ROUTERS,
    zenoh: ZenohFile = None,
    prefix: Annotated[str, typer.Option(help="zenoh.prefix of the gateways.")] = "plant",
    every: Annotated[
        float | None,
        typer.Option(min=0.1, max=86400, help="Seconds between two looks (folder, S3: 300; 10)."),
    ] = None,
    rate: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Samples a second of a gateway, at most.")
    ] = 10_000,
) -> None:
    """Archive each sample of each history once, until Ctrl-C."""
    run_program(archive(Gateways(connect, zenoh, prefix), store, every, rate))


@cli.command()
def status(store: Place, as_json: AsJson = False) -> None:
    """Print how far each gateway is archived, and what is missing."""
    opened = store_at(store)
    try:
        cursors = sorted(opened.cursors().values(), key=lambda cursor: cursor.gateway)
    finally:
        opened.close()
    if not cursors:
        raise GatewayError(f"{store}: nothing is archived here")
    now = time.time()
    if as_json:
        for cursor in cursors:
            print(json.dumps(_document(cursor, now)))
        return
    out.print(
        _table(("gateway", "samples", "newest", "behind"), map(partial(_cells, now), cursors))
    )
    if gaps := [(cursor.gateway, gap) for cursor in cursors for gap in cursor.gaps]:
        cells = ((gateway, _second(gap.begin), _second(gap.end), gap.why) for gateway, gap in gaps)
        out.print(_table(("gateway", "from", "to", "may be missing"), cells))


def _table(columns: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*(Text(printable(cell or "-")) for cell in row))
    return table


def _cells(now: float, cursor: Cursor) -> tuple[str | None, ...]:
    behind = _behind(cursor, now)
    shown = None if behind is None else span(behind)
    newest = rfc3339(cursor.newest) if cursor.newest else None
    return cursor.gateway, str(cursor.samples), _second(newest), shown


def _behind(cursor: Cursor, now: float) -> float | None:
    """Returns the seconds since the store had everything; None: it never had, or a clock that was
    ahead has noted it."""
    behind = now - cursor.whole / 1e6
    return max(0.0, round(behind, 1)) if cursor.whole and behind > -MOST_AHEAD else None


def _second(time: str | None) -> str | None:
    return None if time is None else f"{time[:19]}Z"


def _document(cursor: Cursor, now: float) -> dict[str, object]:
    return {
        "gateway": cursor.gateway,
        "samples": cursor.samples,
        "newest": rfc3339(cursor.newest) if cursor.newest else None,
        "behind": _behind(cursor, now),
        "gaps": [{"from": gap.begin, "to": gap.end, "why": gap.why} for gap in cursor.gaps],
    }
