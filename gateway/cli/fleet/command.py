"""The `fleet` command: asks every gateway under a prefix for its report, in one query."""

import csv
import json
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from gateway.cli.client import connected
from gateway.cli.fleet.rows import Row, State, Told, rows, told_by, wanted_in
from gateway.cli.terminal import FAILED, ROUTER, AsJson, ZenohFile, err, out, printable
from gateway.config import ZenohConfig, ZenohMode
from gateway.config.gateway_address import GatewayAddress
from gateway.contract.line_faults import span
from gateway.errors import ConfigError, GatewayError
from gateway.plant.saved_file import SavedFile

_STYLES = {State.MISSING: "red", State.FAULT: "red", State.LOOK: "yellow", State.GOOD: "green"}


def fleet(
    prefix: Annotated[str, typer.Argument(metavar="PREFIX", help="of the keys, such as `works`.")],
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help=f"A router or a gateway; {ROUTER}."),
    ] = None,
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
    endpoints = tuple(connect or (() if zenoh_file else (ROUTER,)))
    own = ZenohConfig(
        prefix=prefix, mode=ZenohMode.CLIENT, connect=endpoints, config_file=zenoh_file
    )
    if folder is not None and not folder.is_dir():
        raise ConfigError(f"{folder} is no folder")
    with connected(GatewayAddress(name="fleet", standby=None, zenoh=own), err.print) as client:
        asked = time.time()
        told, mistakes = told_by(client.reports(), asked)
    wanted, wrong = (None, []) if folder is None else wanted_in(folder)
    if wanted is not None:
        wanted = {name: one for name, one in wanted.items() if _is_below(name, prefix)}
    seen = {} if remember is None else _remembered(remember, told)
    found = rows(told, wanted, {name: at for name, at in seen.items() if _is_below(name, prefix)})
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


def _is_below(gateway: str, prefix: str) -> bool:
    return f"{gateway}/".startswith(f"{prefix}/")


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
        stand = f" ({report['stand']})" if report["stand"] else ""
        table.add_row(
            Text(printable(row.gateway)),
            Text.assemble(state, stand),
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
        cells = (one.get(name, "") for name in columns)
        writer.writerow([json.dumps(c) if isinstance(c, dict) else c for c in cells])
