"""The `status` command: lines, devices, connections, history and what is wrong, in one view."""

import json
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.cli.client import reached
from gateway.cli.repeated import repeated
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, err, out, printable
from gateway.contract.faults import (
    ALARM_STATES,
    Documents,
    below,
    faults,
    transfers,
    warnings,
)
from gateway.contract.line_faults import span

HOUR = "now(-1h)"
_NOT_REAL = ("simulated", "replayed")  # as `NotReal` of tags: `health` shall not import them
_STYLES = {"up": "green", "open": "green", "silent": "red", "down": "red", "failing": "yellow"}
_STYLES |= {"carried": "green", "waiting": "yellow", "stale": "red", "refused": "red"}
_STYLES |= {"unclear": "red", "connected": "green", "dialling": "yellow", "doubtful": "yellow"}


def status(
    config: ConfigPath,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show it again every second. Ctrl-C ends it.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print lines, devices, history and what is wrong, from the running gateway."""
    with reached(config, err.print, waits=watch and not as_json) as client:
        if watch and not as_json:
            repeated(lambda: view(client.documents(), client.outcomes(HOUR)))
            return
        documents = client.documents()
        if as_json:
            print(json.dumps(documents))
        else:
            out.print(view(documents, client.outcomes(HOUR)))
        if any(faults(documents)):
            sys.exit(FAILED)


def health(
    config: ConfigPath,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Fail also on a silent device, a line down, a transfer that does not work, "
            "history not written.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print one sentence about the running gateway. Exit code 0 if it replies (for containers)."""
    with reached(config, err.print) as client:
        documents: Documents = client.documents() if strict else {"status": client.status()}
        sentence = f"{_title(documents)}: it answers"
        print(json.dumps(documents["status"]) if as_json else printable(sentence))
        found = list(faults(documents)) if strict else []
        for sentence in found:
            err.print(printable(sentence))
        if found:
            sys.exit(FAILED)


def _title(documents: Documents) -> str:
    gateway = documents["status"]
    return f"{gateway['name']} {gateway['version']}, up {span(gateway['up'])}"


def view(documents: Documents, outcomes: list[dict[str, Any]] | None) -> RenderableType:
    """Returns the whole status. `outcomes` of the last hour; None without history."""
    tags = documents["status"]["tags"]
    size = f"{tags} tag" if tags == 1 else f"{tags} tags"
    parts: list[RenderableType] = [
        Text(printable(f"{_title(documents)}, {size}{_standby(documents)}")),
        Text(),
        _lines(documents),
        Text(),
        _devices(documents),
        Text(),
        *_calls(documents),
        *_transfers(documents),
        *doors_table(below("doors/", documents)),
        _services(documents, outcomes),
    ]
    for heading, style, found in (
        ("wrong", "red", list(faults(documents))),
        ("to look at", "yellow", list(warnings(documents))),
    ):
        if found:
            parts += [Text(), Text(f"{heading}:")]
            parts += [Text(printable(f"  {sentence}"), style=style) for sentence in found]
    return Group(*parts)


def _standby(documents: Documents) -> str:
    standby = documents.get("standby")
    return "" if standby is None else f", {standby['stand']} in group {standby['group']}"


def _lines(documents: Documents) -> Table:
    status = documents["status"]
    origins = {name: word for word in _NOT_REAL for name in status.get(word, ())}
    table = _table("line", "state", "open for", "load", "expected", "requests/s", "slowest write")
    for name, document in below("lines/", documents):
        measured, expected = document["measured"], document["expected"]
        doubtful = document.get("doubtful", False)
        opened = "doubtful" if doubtful else "open"
        table.add_row(
            Text(name),
            _state(origins.get(name, opened) if document["open"] else "down"),
            Text(span(document["open_for"])),
            Text(_share(measured["load"])),
            Text(_share(expected["load_proven" if doubtful else "load"])),
            Text(_number(measured["requests_per_second"])),
            Text(f"{measured['slowest_write']:.2f} s"),
        )
    return table


def _devices(documents: Documents) -> Table:
    table = _table("device", "line", "state", "turnaround", "longest gap", "failures", "refused")
    lines = {
        device: line
        for line, document in below("lines/", documents)
        for device in document["devices"]
    }
    for name, document in below("devices/", documents):
        turnaround = document["turnaround"]
        gaps = [one["worst_age"] for one in document["requests"] if one["worst_age"] is not None]
        table.add_row(
            Text(name),
            Text(lines.get(name, "")),
            _state(document["standing"]),
            Text("-" if turnaround is None else f"{turnaround * 1000:.0f} ms"),
            Text(f"{max(gaps):.2f} s" if gaps else "-"),
            Text(_counts(document["failures"])),
            Text(_counts(document["refusals"])),
        )
    return table


def _calls(documents: Documents) -> list[RenderableType]:
    """Returns the table of the telephone calls; nothing without a modem."""
    table = _table("calls", "state", "for", "next call", "last result", "made", "failed")
    for name, document in below("lines/", documents):
        if calls := document["calls"]:
            since, until = calls.get("since"), calls.get("next")
            table.add_row(
                Text(name),
                _state(calls.get("state", "")),
                "-" if since is None else span(since),
                "-" if until is None else f"in {span(until)}",
                Text(printable(calls.get("last_result") or "-")),
                str(calls["made"]),
                str(calls["failed"]),
            )
    return [table, Text()] if table.rows else []


def _transfers(documents: Documents) -> list[RenderableType]:
    """Returns the table of the transfers; nothing without any."""
    rows = transfers(documents)
    table = _table("transfer")
    for end in ("from", "to"):
        table.add_column(end, overflow="fold")  # whole in a narrow terminal too
    for column in ("state", "code", "last", "carried", "unclear"):
        table.add_column(column)
    for number, document in rows:
        table.add_row(
            number,
            Text(printable(document["from"])),
            Text(printable(document["to"])),
            _state(document["state"]),
            document["code"] or "-",
            _ago(document.get("last_carried")),
            str(document["carried"]),
            str(document["unclear"]),
        )
    return [table, Text()] if rows else []


def doors_table(doors: Iterable[tuple[str, Mapping[str, Any]]]) -> list[RenderableType]:
    """Returns the table of the doors and the programs there; nothing without any."""
    table = _table("door", "line", "share", "program", "for", "requests", "writes", "refused")
    for name, document in doors:
        door = (Text(name), Text(document["line"]), f"{_share(document['share'])} of the wire")
        for program in document["programs"]:
            counts = (str(program[one]) for one in ("requests", "writes", "refused"))
            table.add_row(*door, Text(program["address"]), span(program["since"]), *counts)
        if not document["programs"]:
            table.add_row(*door, "-")
    return [table, Text()] if table.rows else []


def _services(documents: Documents, outcomes: list[dict[str, Any]] | None) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    zenoh = documents.get("zenoh", {})
    links: Counter[str] = Counter(zenoh.get("to", ()))
    to = ", ".join(f"{number} {kind}" for kind, number in links.items()) or "no connection"
    table.add_row(
        "Zenoh", Text(printable(f"{to}; {zenoh.get('congested', 0)} puts met a full link"))
    )
    history = documents.get("history")
    text = "not kept" if history is None else f"{history['state']}, {history['waiting']} waiting"
    table.add_row("history", Text(printable(text)))
    if (reload := documents.get("reload")) is not None:
        again = f", {reload['reloads']} reloads" if reload["reloads"] else ""
        table.add_row("file", Text(printable(f"of {reload['loaded'][:19]}Z{again}")))
    if alarms := documents.get("alarms"):
        states = [state for state in ALARM_STATES[1:] if alarms.get(state)]
        text = ", ".join(f"{alarms[state]} {state}" for state in states)
        table.add_row("alarms", Text(text.replace("_", " ") or "none"))
    if outcomes is not None:
        known = Counter(str(outcome.get("outcome")) for outcome in outcomes)
        text = ", ".join(f"{number} {outcome}" for outcome, number in known.most_common())
        table.add_row("writes", Text(printable(f"{text or 'none'} in the last hour")))
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(column)
    return table


def _state(text: str) -> Text:
    return Text(text, style=_STYLES.get(text, ""))


def _share(load: float | None) -> str:
    return "-" if load is None else f"{load * 100:.0f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _ago(seconds: float | None) -> str:
    return "-" if seconds is None else f"{span(seconds)} ago"


def _counts(counts: Mapping[str, int]) -> str:
    return printable(", ".join(f"{number} {kind}" for kind, number in counts.items())) or "-"
