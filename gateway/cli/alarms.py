"""The `alarms` command: the alarms of the running gateway, and the orders of operators."""

import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatchcase
from typing import Annotated, Any

import typer
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from gateway.cli import completion
from gateway.cli.client import Client, reached, suggestion
from gateway.cli.repeated import repeated
from gateway.cli.terminal import (
    FAILED,
    USER_MISTAKE,
    AsJson,
    ConfigPath,
    err,
    out,
    printable,
)
from gateway.config.settings import parsers
from gateway.errors import ConfigError

_ORDER = ("active", "returned", "acknowledged", "normal")
_URGENT = {"critical": -1, "high": 0, "low": 2}  # of others 1
_STYLES = {"active": "red", "returned": "yellow", "acknowledged": "yellow"}
_AT_ONCE = 32  # acknowledgements
_MISTAKES = ("bad-value", "unknown-tag")


def _alarm(option: str, text: str) -> Any:
    return typer.Option(option, metavar="ALARM", help=text, autocompletion=completion.alarms)


def alarms(
    config: ConfigPath,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show them again every second. Ctrl-C ends it.")
    ] = False,
    every: Annotated[bool, typer.Option("--all", help="Also alarms that are normal.")] = False,
    past: Annotated[
        str | None,
        typer.Option("--past", metavar="TIME", help="What changed in this time, such as 1d."),
    ] = None,
    ack: Annotated[
        str | None,
        _alarm(
            "--ack", "Acknowledge device/tag, device or line:name; '*' or 'mixer/*': all these."
        ),
    ] = None,
    shelve: Annotated[
        str | None, _alarm("--shelve", "Shelve an alarm; with --for and --reason.")
    ] = None,
    unshelve: Annotated[str | None, _alarm("--unshelve", "End the shelving of an alarm.")] = None,
    remove: Annotated[
        str | None, _alarm("--out-of-service", "Take an alarm out of service; with --reason.")
    ] = None,
    put_back: Annotated[str | None, _alarm("--in-service", "Put an alarm back.")] = None,
    by: Annotated[
        str | None, typer.Option("--by", metavar="NAME", help="The operator who orders it.")
    ] = None,
    for_: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long, such as 2h.")
    ] = None,
    reason: Annotated[str | None, typer.Option(metavar="TEXT", help="Why.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the alarms that are not normal, from the running gateway, or acknowledge, shelve and
    take them out of service."""
    orders = {
        "acknowledge": ack,
        "shelve": shelve,
        "unshelve": unshelve,
        "out-of-service": remove,
        "in-service": put_back,
    }
    given = [(do, alarm) for do, alarm in orders.items() if alarm is not None]
    if len(given) > 1 or bool(given) is not (by is not None):
        raise ConfigError("give one of --ack, --shelve and others, with --by NAME, the operator")
    if not given:
        with reached(config, err.print, waits=watch and not as_json) as client:
            since = None if past is None else f"now(-{parsers.duration(past):g}s)"
            _print(client, since, watch=watch, every=every, as_json=as_json)
        return
    [(do, alarm)] = given
    fields: dict[str, object] = {"by": by}
    if do != "acknowledge":
        fields["do"] = do
    if for_ is not None:
        fields["seconds"] = parsers.duration(for_)
    if reason is not None:
        fields["reason"] = reason
    with reached(config, err.print) as client:
        if do == "acknowledge" and "*" in alarm:
            _acknowledge_all(client, alarm, fields, as_json=as_json)
            return
        if alarm not in (known := [one["alarm"] for one in client.alarms()]):
            raise ConfigError(f"there is no alarm {alarm}{suggestion(alarm, known)}")
        if problem := _order(client, alarm, fields, as_json=as_json):
            sys.exit(USER_MISTAKE if problem in _MISTAKES else FAILED)


def _print(client: Client, since: str | None, *, watch: bool, every: bool, as_json: bool) -> None:
    if watch and not as_json:
        repeated(lambda: view(_alarms(client, every=every)))
        return
    found = _alarms(client, every=every) if since is None else client.past_alarms(since)
    if as_json:
        print(json.dumps(found))
    else:
        out.print(view(found) if since is None else past_view(found))


def _alarms(client: Client, *, every: bool) -> list[dict[str, Any]]:
    found = [one for one in client.alarms() if every or one["state"] != "normal" or _rest(one)]
    # Of one state and priority the newest first.
    found.sort(key=lambda one: str(one["since"]), reverse=True)
    found.sort(key=lambda one: _URGENT.get(one.get("priority", ""), 1))
    return sorted(found, key=lambda one: _ORDER.index(one["state"]))


def _rest(one: dict[str, Any]) -> str:
    """Returns who shelved the alarm or took it out of service, and why; empty: nobody."""
    if what := one.get("shelved"):
        return f"shelved until {_moment(what['until'])} by {what['by']}: {what['reason']}"
    if what := one.get("out_of_service"):
        return f"out of service by {what['by']}: {what['reason']}"
    return ""


def _acknowledge_all(
    client: Client, pattern: str, fields: dict[str, object], *, as_json: bool
) -> None:
    """Acknowledges each alarm as it is now: one that is raised again meanwhile stays active."""
    open_ones = [one for one in client.alarms() if one["state"] in ("active", "returned")]
    found = [one for one in open_ones if fnmatchcase(one["alarm"], pattern)]

    def send(one: dict[str, Any]) -> dict[str, object]:
        return client.requests.order(f"alarms/{one['alarm']}", fields | {"raised": one["raised"]})

    # The gateway writes its file once for all that arrive together.
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        answers = zip(found, threads.map(send, found), strict=True)
        failed = [
            one["alarm"]
            for one, answer in answers
            if _said(one["alarm"], fields, answer, as_json=as_json)
        ]
    if not as_json:
        done = f"{len(found) - len(failed)} of {len(found)} alarms acknowledged"
        print(done if found else f"no alarm of '{pattern}' waits for acknowledgement")
    if failed:
        sys.exit(FAILED)


def _order(client: Client, alarm: str, fields: dict[str, object], *, as_json: bool) -> str:
    """Sends an order, and prints its answer. Returns the error word; empty: it is done."""
    answer = client.requests.order(f"alarms/{alarm}", fields)
    return _said(alarm, fields, answer, as_json=as_json)


def _said(
    alarm: str, fields: dict[str, object], answer: dict[str, object], *, as_json: bool
) -> str:
    """Prints the answer to an order. Returns the error word; empty: it is done."""
    if as_json:
        print(json.dumps(answer))
    if "error" in answer:
        if not as_json:
            err.print(printable(f"{answer['error']}: {answer['reason']}"), style="red")
        return str(answer["error"])
    if not as_json:
        by: Any = answer["acknowledged"] if "do" not in fields else None
        done = by and f"acknowledged by {by['by']} at {by['time']}, now {answer['state']}"
        print(printable(f"{alarm}: {done or _rest(answer) or answer['state']}"))
    return ""


def view(found: Sequence[dict[str, Any]]) -> RenderableType:
    """Returns the alarms as a table."""
    if not found:
        return Text("no alarms")
    table = Table(box=None, pad_edge=False)
    for column in (
        "alarm",
        "priority",
        "state",
        "limit",
        "value",
        "since",
        "acknowledged by",
        "text",
    ):
        table.add_column(column)
    for one in found:
        limit = "" if one["limit"] in (None, True, False) else f" {one['limit']:g}"
        by = one["acknowledged"]
        part = f"part of {one['part_of']}" if "part_of" in one else ""
        texts = (one["text"], part or (one.get("detail", "") if one["value"] is True else ""))
        rest = _rest(one)
        table.add_row(
            Text(printable(one["alarm"])),
            Text(one.get("priority", "")),
            Text(_state(one), style=_STYLES.get(one["state"], "")),
            Text(f"{one['level'] or ''}{limit}"),
            Text(printable(_value(one)), style="" if one["quality"] == "good" else "red"),
            Text(_moment(one["since"] or "")),
            Text(printable("" if by is None else by["by"])),
            Text(printable(rest or ": ".join(text for text in texts if text))),
        )
    return table


def past_view(found: Sequence[dict[str, Any]]) -> RenderableType:
    """Returns changes of alarms as a table."""
    if not found:
        return Text("no changes of alarms")
    table = Table(box=None, pad_edge=False)
    for column in ("time", "alarm", "priority", "what", "state", "value", "by", "text"):
        table.add_column(column)
    for one in found:
        what = str(one.get("change") or one["event"])
        by = one["acknowledged"] if one["event"] == "acknowledged" else one
        reason = _rest(one) or (f"part of {one['part_of']}" if "part_of" in one else one["text"])
        table.add_row(
            Text(_moment(one["since"] or "")),
            Text(printable(one["alarm"])),
            Text(one.get("priority", "")),
            Text(f"{what} {one['level']}" if what in ("raised", "eased") else what),
            Text(one["state"], style=_STYLES.get(one["state"], "")),
            Text(printable(_shown(one["value_at_change"], one["unit"]))),
            Text(printable(by.get("by") or "")),
            Text(printable(reason)),
        )
    return table


def _state(one: dict[str, Any]) -> str:
    if "shelved" in one:
        return "shelved"
    return "out of service" if "out_of_service" in one else str(one["state"])


def _moment(time: str) -> str:
    return time[:19].replace("T", " ")


def _value(one: dict[str, Any]) -> str:
    if one["quality"] != "good":
        return f"bad {one.get('reason') or ''}".strip()
    if "time" not in one:  # of a line or a device
        return "-"
    return _shown(one["value"], one["unit"])


def _shown(value: object, unit: str) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value} {unit}".strip()
