"""The `fleet PREFIX apply` command: gives many gateways their files, canaries first."""

import json
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import orjson
import typer
from rich.table import Table
from rich.text import Text

from gateway.cli.client import Client
from gateway.cli.fleet.health import read_remote
from gateway.cli.fleet.place import Connect, Place
from gateway.cli.fleet.rollout import DONE, KEY, Ended, Pace, Result, Rollout, Step
from gateway.cli.terminal import FAILED, AsJson, ZenohFile, err, out, printable
from gateway.config.settings.parsers import interval
from gateway.config.whole import whole_text
from gateway.contract.documents.fleet import RemoteDocument
from gateway.contract.fleet_files import Wanted
from gateway.contract.fleet_rows import Told, gateway_of, told_by
from gateway.contract.line_faults import span
from gateway.errors import ConfigError, GatewayError

_SHORTEST = 10.0  # seconds until an unconfirmed file goes back
_MOST_AT_ONCE = 200


def apply(
    ctx: typer.Context,
    folder: Annotated[Path, typer.Argument(help="The files, each with its gateway's name.")],
    connect: Connect = None,
    zenoh_file: ZenohFile = None,
    canary: Annotated[int, typer.Option(min=0, help="So many first, and alone.")] = 1,
    wait: Annotated[str, typer.Option(help="How long to watch the canaries.")] = "1min",
    look: Annotated[str, typer.Option(help="How long to watch each other one.")] = "20s",
    parallel: Annotated[
        int, typer.Option(min=1, max=_MOST_AT_ONCE, help="So many at the same time.")
    ] = 10,
    within: Annotated[str, typer.Option(help="Then an unconfirmed file goes back.")] = "2min",
    check: Annotated[bool, typer.Option("--check", help="Check the files there only.")] = False,
    back: Annotated[
        bool, typer.Option("--back", help="Roll back those that run these files.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Give gateways their files: canaries first, each watched, and taken back if it is not well."""
    pace = Pace(canary, interval(wait), interval(look), interval(within), parallel)
    if pace.within < _SHORTEST:
        raise ConfigError(f"--within is shorter than {_SHORTEST:.0f} s")
    if check and back:
        raise ConfigError("--check and --back do not go together")
    do = "check" if check else "rollback" if back else "apply"
    place: Place = ctx.obj
    wanted, mistakes = place.wanted(folder)
    if mistakes:
        raise ConfigError("\n".join([*mistakes, "nothing was sent"]))
    began = time.monotonic()
    with place.connected(connect, zenoh_file) as client:
        told, unclear = told_by(client.everywhere("report"), time.time())
        for mistake in unclear:
            err.print(printable(mistake))
        steps, ended = _steps(wanted, told, _changes(client), do)
        for one in ended:
            _tell(one)
        rollout = Rollout(client, steps, _tell)
        ended += rollout.check(parallel) if check else rollout.run(pace)
    if as_json:
        for one in ended:
            print(json.dumps(one._asdict()))
    else:
        out.print(_table(ended))
        counts = Counter(one.result for one in ended)
        text = ", ".join(f"{number} {result}" for result, number in counts.items())
        out.print(Text(f"{len(ended)} gateways: {text}. It took {span(time.monotonic() - began)}."))
    new = sum(one.result is Result.CONFIRMED for one in ended)
    if all(one.result in DONE for one in ended) and ended:
        return
    if new and not back:
        what = f"{new} have the new file: --back instead of the other options takes it back"
        err.print(f"{what}; the same command goes on with the others")
    sys.exit(FAILED)


def _changes(client: Client) -> dict[str, RemoteDocument]:
    """Returns the last change of each gateway that takes files."""
    found = {}
    for key, payload, _ in client.everywhere(KEY):
        gateway = gateway_of(key, KEY)
        try:
            found[gateway] = read_remote(orjson.loads(payload))
        except (orjson.JSONDecodeError, GatewayError) as error:
            raise GatewayError(f"{gateway}: {error}") from None
    return found


def _steps(
    wanted: Mapping[str, Wanted],
    told: Mapping[str, Told],
    changes: Mapping[str, RemoteDocument],
    do: str,
) -> tuple[dict[str, Step], list[Ended]]:
    """Returns a step for each gateway that shall have another file, those without a fault first,
    and the end of each other one. Raises `GatewayError` while a file waits."""
    steps, ended = dict[str, Step](), list[Ended]()
    for gateway in sorted(
        wanted, key=lambda one: (one in told and bool(told[one].report["fault"]), one)
    ):
        want, one, change = wanted[gateway], told.get(gateway), changes.get(gateway)
        if one is None:
            ended.append(Ended(gateway, Result.UNREACHABLE, "no reply"))
        elif one.is_twin:
            ended.append(Ended(gateway, Result.REFUSED, "two gateways have this name: rename one"))
        elif change is None:
            ended.append(Ended(gateway, Result.REFUSED, "its file has no section `remote`"))
        elif change["state"] == "waiting" and do != "check":
            who = f"the file of {change['by']} waits until {change['until']}"
            why = "another rollout is at work, or one was broken off: nothing was sent"
            raise GatewayError(f"{gateway}: {who}: {why}")
        elif one.report["stand"] not in (None, "active"):
            ended.append(Ended(gateway, Result.LEFT, "it stands by: give it its file by hand"))
        elif do == "rollback":
            ran = (change["state"], change["digest"], one.report["digest"])
            if ran != ("confirmed", want.digest, want.digest):
                ended.append(Ended(gateway, Result.SAME, "no command gave it this file"))
            else:
                steps[gateway] = Step({"do": do, "digest": change["before"]}, change["before"])
        elif one.report["digest"] == want.digest:
            ended.append(Ended(gateway, Result.SAME))
        else:
            order = {"do": do, "file": whole_text(want.file), "digest": want.digest}
            steps[gateway] = Step(order, want.digest)
    return steps, ended


def _tell(ended: Ended) -> None:
    says = f": {ended.says}" if ended.says else ""
    err.print(printable(f"{ended.gateway}: {ended.result}{says}"))


def _table(ended: Sequence[Ended]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("gateway", "result", ""):
        table.add_column(column)
    for one in sorted(ended, key=lambda one: (one.result in DONE, one.gateway)):
        style = "green" if one.result in DONE else "red"
        row = (Text(printable(one.gateway)), Text(one.result, style=style))
        table.add_row(*row, Text(printable(one.says)))
    return table
