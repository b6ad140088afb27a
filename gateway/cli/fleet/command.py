"""The `fleet` commands: asks every gateway under a prefix for its report, in one query."""

import csv
import json
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from gateway.cli.examples import epilog
from gateway.cli.fleet.apply import apply
from gateway.cli.fleet.place import Connect, Place
from gateway.cli.fleet.render import render
from gateway.cli.terminal import FAILED, AsJson, ZenohFile, err, out, printable
from gateway.config.sheets import neutral
from gateway.contract.fleet_rows import Row, State, Told, rows, told_by
from gateway.contract.line_faults import span
from gateway.errors import GatewayError
from gateway.plant.saved_file import SavedFile

_STYLES = {State.MISSING: "red", State.FAULT: "red", State.LOOK: "yellow", State.GOOD: "green"}


class _AfterPrefix(TyperGroup):
    """A command may follow the prefix. Options of `fleet` stand anywhere before it."""

    allow_interspersed_args = True

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        at = next((at for at, one in enumerate(args) if at and one in self.commands), len(args))
        return super().parse_args(ctx, [*args[:at], "--", *args[at:]] if args else args)


cli = typer.Typer(cls=_AfterPrefix, invoke_without_command=True, epilog=epilog("fleet"))
cli.command()(apply)
cli.command()(render)


@cli.callback()
def fleet(
    ctx: typer.Context,
    prefix: Annotated[str, typer.Argument(metavar="PREFIX", help="of the keys, such as `works`.")],
    connect: Connect = None,
    zenoh_file: ZenohFile = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="The files as they should be: shows what differs and what is missing."),
    ] = None,
    remember: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keeps who replied, to show who is silent since when."),
    ] = None,
    as_json: AsJson = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="One row for each gateway.")] = False,
) -> None:
    """Print all gateways under a prefix, the worst first."""
    place = ctx.obj = Place(prefix, connect, zenoh_file)
    if ctx.invoked_subcommand is not None:
        return
    wanted, wrong = (None, []) if folder is None else place.wanted(folder)
    with place.connected() as client:
        asked = time.time()
        told, mistakes = told_by(client.everywhere("report"), asked)
    seen = {} if remember is None else _remembered(remember, told)
    found = rows(told, wanted, {name: at for name, at in seen.items() if place.has(name)})
    if as_json:
        for row in found:
            print(json.dumps(row.document()))
    elif as_csv:
        _print_csv(found)
    else:
        out.print(_table(found))
        out.print(_summary(found, time.time() - asked))
    for mistake in (*mistakes, *wrong):
        err.print(printable(mistake))
    bad = (State.MISSING, State.FAULT)
    if mistakes or wrong or not found or any(row.state in bad for row in found):
        sys.exit(FAILED)


def _remembered(path: Path, told: Mapping[str, Told]) -> dict[str, str]:
    """Returns when each gateway replied last, and keeps it. Raises `GatewayError`."""
    file = SavedFile(path)
    seen = file.load(lambda found: {str(name): str(at) for name, at in found.items()}) or {}
    seen |= {name: one.report["time"] for name, one in told.items()}
    file.save(json.dumps(seen, indent=1).encode())
    if file.trouble:
        raise GatewayError(f"{path}: {file.trouble}")
    return seen


def _table(found: Sequence[Row]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("gateway", "state", "version", "up", "tags", "devices", "load", "file", ""):
        table.add_column(column)
    for row in found:
        state = Text(row.state.name.lower(), style=_STYLES[row.state])
        if row.told is None:
            table.add_row(Text(printable(row.gateway)), state, *6 * "-", Text(printable(row.says)))
            continue
        report = row.told.report
        load = "-" if report["load"] is None else f"{report['load']:.0%}"
        devices = ", ".join(f"{number} {word}" for word, number in report["devices"].items())
        stand = f" ({report.get('group', '?')}: {report['stand']})" if report["stand"] else ""
        table.add_row(
            Text(printable(row.gateway)),
            Text.assemble(state, printable(stand)),
            Text(printable(report["version"])),
            Text(span(report["up"])),
            Text(str(report["tags"])),
            Text(printable(devices) or "-"),
            Text(load),
            Text(printable(report["revision"] or report["digest"])),
            Text(printable(row.says)),
        )
    return table


def _summary(found: Sequence[Row], took: float) -> Text:
    states = Counter(row.state for row in found)
    told = ", ".join(f"{number} {state.name.lower()}" for state, number in sorted(states.items()))
    causes = Counter[str]()
    for row in found:
        causes.update({} if row.told is None else row.told.report["faults"])
    faults = ", ".join(f"{number} {code}" for code, number in causes.most_common())
    faults = f"; faults: {printable(faults)}" if faults else ""
    return Text(f"{len(found)} gateways: {told or 'none replied'}{faults}. It took {took:.1f} s.")


def _print_csv(found: Sequence[Row]) -> None:
    documents = [row.document() for row in found]
    columns = list(dict.fromkeys(name for one in documents for name in one))
    writer = csv.writer(sys.stdout)
    writer.writerow(columns)
    for one in documents:
        writer.writerow([_cell(one.get(name, "")) for name in columns])


def _cell(value: object) -> object:
    """A sentence of a gateway may quote what another program has sent."""
    if isinstance(value, dict):
        return json.dumps(value)
    return neutral(value) if isinstance(value, str) else value
