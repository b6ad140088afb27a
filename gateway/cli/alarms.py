"""The `alarms` command: the alarms of the running gateway, and the acknowledgement of one."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

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
from gateway.errors import ConfigError

_ORDER = ("active", "returned", "acknowledged", "normal")
_URGENT = ("critical", "high", "medium", "low")
_STYLES = {"active": "red", "returned": "yellow", "acknowledged": "yellow"}
_MISTAKES = ("bad-value", "unknown-tag")


def alarms(
    config: ConfigPath,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show them again every second. Ctrl-C ends it.")
    ] = False,
    every: Annotated[bool, typer.Option("--all", help="Also alarms that are normal.")] = False,
    ack: Annotated[
        str | None,
        typer.Option("--ack", metavar="ALARM", help="Acknowledge device/tag, device or line:name."),
    ] = None,
    by: Annotated[
        str | None, typer.Option("--by", metavar="NAME", help="Operator that acknowledges.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the alarms that are not normal, from the running gateway, or acknowledge one."""
    if (ack is None) is not (by is None):
        raise ConfigError("--ack needs --by NAME, the operator that acknowledges, and --by --ack")
    if ack is not None and ack not in (known := _known(config)):
        raise ConfigError(f"there is no alarm {ack} in {config}{suggestion(ack, known)}")
    with reached(config, err.print) as client:
        if ack is not None and by is not None:
            _acknowledge(client, ack, by, as_json=as_json)
        elif watch and not as_json:
            repeated(lambda: view(_alarms(client, every=every)))
        else:
            found = _alarms(client, every=every)
            if as_json:
                print(json.dumps(found))
            else:
                out.print(view(found))


def _known(path: Path) -> dict[str, None]:
    """Returns the names of all alarms of the file."""
    from gateway.config import load
    from gateway.parts.alarms.watched import LINE  # with all protocols, as `load`
    from gateway.tags import AlarmRule

    config = load(path)
    known = (tag for device in config.devices for tag in device.tags)
    tags = (tag.key for tag in known if tag.feature(AlarmRule) is not None)
    devices = (device.name for device in config.devices)
    return dict.fromkeys([*tags, *devices, *(f"{LINE}{line.name}" for line in config.lines)])


def _alarms(client: Client, *, every: bool) -> list[dict[str, Any]]:
    found = [one for one in client.alarms() if every or one["state"] != "normal"]
    # Of one state and priority the newest first.
    found.sort(key=lambda one: str(one["since"]), reverse=True)
    found.sort(key=lambda one: _URGENT.index(one.get("priority", "medium")))
    return sorted(found, key=lambda one: _ORDER.index(one["state"]))


def _acknowledge(client: Client, alarm: str, by: str, *, as_json: bool) -> None:
    answer = client.acknowledge(alarm, by)
    if as_json:
        print(json.dumps(answer))
    if "error" in answer:
        if not as_json:
            err.print(printable(f"{answer['error']}: {answer['reason']}"), style="red")
        sys.exit(USER_MISTAKE if answer["error"] in _MISTAKES else FAILED)
    if not as_json:
        known: Any = answer["acknowledged"]
        text = f"{alarm}: acknowledged by {known['by']} at {known['time']}, now {answer['state']}"
        print(printable(text))


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
        table.add_row(
            Text(printable(one["alarm"])),
            Text(one.get("priority", "")),
            Text(one["state"], style=_STYLES.get(one["state"], "")),
            Text(f"{one['level'] or ''}{limit}"),
            Text(printable(_value(one)), style="" if one["quality"] == "good" else "red"),
            Text(str(one["since"] or "")[:19].replace("T", " ")),
            Text(printable("" if by is None else by["by"])),
            Text(printable(": ".join(text for text in texts if text))),
        )
    return table


def _value(one: dict[str, Any]) -> str:
    if one["quality"] != "good":
        return f"bad {one.get('reason') or ''}".strip()
    if "time" not in one:  # of a line or a device
        return "-"
    if isinstance(one["value"], bool):
        return "on" if one["value"] else "off"
    return f"{one['value']} {one['unit']}".strip()
