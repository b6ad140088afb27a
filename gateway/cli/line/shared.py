"""The `line` command: the programs that share a line, and what they read again and again."""

import json
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.text import Text

from gateway.cli import completion
from gateway.cli.client import Client, reached, suggestion
from gateway.cli.status import doors_table
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, end, err, out, printable
from gateway.contract.faults import below
from gateway.errors import ConfigError, GatewayError

_ALONE = ("raw", "rfc2217")  # the program has the wire alone
_ROUND = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60)  # seconds


def line(
    config: ConfigPath,
    name: Annotated[str, typer.Argument(metavar="LINE", autocompletion=completion.lines)],
    do: Annotated[
        str, typer.Argument(metavar="[release]", help="take the wire back from a program")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Print the programs at the doors of a line, and what they read as proposals for tags; or
    take the wire back from the program that has it alone."""
    if do not in ("", "release"):
        raise ConfigError(f"write release, or nothing: {do} is nothing that a line can do")
    with reached(config, err.print) as client:
        documents = client.documents()
        lines = [line for line, _ in below("lines/", documents)]
        if name not in lines:
            raise ConfigError(f"there is no line {name}{suggestion(name, lines)}")
        doors = {door: one for door, one in below("doors/", documents) if one["line"] == name}
        if do:
            _release(client, name, doors)
        elif as_json:
            print(json.dumps(doors))
        elif doors:
            out.print(Group(*doors_table(doors.items()), Text(_proposals(doors))))
        else:
            print(f"line {name} has no doors: see `share` in the file")


def _release(client: Client, name: str, doors: dict[str, Any]) -> None:
    alone = [door for door, one in doors.items() if one["protocol"] in _ALONE and one["programs"]]
    if not alone:
        raise GatewayError(f"no program has the wire of {name} alone")
    for door in alone:
        answer = client.requests.order(f"doors/{door}", {"do": "release"})
        if "error" in answer:
            end(printable(f"{answer['error']}: {answer['reason']}"), FAILED)
        who = ", ".join(program["address"] for program in doors[door]["programs"])
        print(printable(f"{name} was taken back from {door} ({who})"))


def _proposals(doors: dict[str, Any]) -> str:
    """Returns tags as the file has them, for addresses that no tag has."""
    reads = [read for one in doors.values() for read in one["reads"]]
    if not reads:
        return "no address was read three times"
    rows = ["read again and again, the most frequent first:"]
    for read in reads:
        tags = ", ".join(read["tags"]) or "no tag"
        what = f"{read['device']} {read['address']} {read['type']}"
        rows.append(f"  {what}, {read['count']} times, every {read['every']:g} s: {tags}")
    new = {(read["device"], read["address"]): read for read in reads if not read["tags"]}
    if new:
        rows.append("tags for the file:")
    for device in dict.fromkeys(device for device, _ in new):
        rows += [f"  {device}:", "    tags:"]
        for (of, address), read in new.items():
            if of == device:
                every = next((one for one in _ROUND if one >= read["every"]), _ROUND[-1])
                tag = f"address: {json.dumps(address)}, type: {json.dumps(read['type'])}"
                rows.append(f"      {address.replace(':', '-')}: {{{tag}, every: {every:g}s}}")
    return printable("\n".join(rows), "\n")
