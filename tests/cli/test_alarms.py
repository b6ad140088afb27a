"""The command `alarms` at a running gateway: shelving, and what its lists show."""

import io
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gateway.cli.alarms import past_view
from tests.conftest import Command


def test_an_alarm_is_shelved_listed_and_put_back(running: Path, command: Command) -> None:
    def told(*options: str) -> str:
        return command("alarms", running, *options, "--by", "Ana").out.strip()

    shelved = r"shelved until \d{4}-\S+ \S+ by Ana: being repaired"
    shelve = "--shelve", "mixer", "--for", "2h", "--reason", "being repaired"
    assert re.fullmatch(f"mixer: {shelved}", told(*shelve))
    [row] = command("alarms", running).out.splitlines()[1:]
    assert re.fullmatch(rf"mixer +high +shelved .*{shelved}\s*", row)
    [document] = command("alarms", running, "--json").json
    assert document["shelved"]["reason"] == "being repaired"
    assert re.search(r"^alarms +1 shelved *$", command("status", running).out, re.MULTILINE)
    assert told("--unshelve", "mixer") == "mixer: normal"
    removed = "--out-of-service", "mixer", "--reason", "rebuilt"
    assert told(*removed) == "mixer: out of service by Ana: rebuilt"
    assert told("--in-service", "mixer") == "mixer: normal"
    assert told("--ack", "*") == "no alarm of '*' waits for acknowledgement"
    assert command("alarms", running).out.strip() == "no alarms"


def test_past_alarms_say_what_changed_and_who_did_it() -> None:
    plain: dict[str, Any] = {
        "alarm": "mixer/speed",
        "priority": "high",
        "state": "active",
        "level": "high",
    }
    plain |= {"value_at_change": 85, "unit": "%", "text": "too fast", "acknowledged": None}
    what = {"by": "Bo", "time": "2026-11-20T12:00:03Z", "reason": "rebuilt", "via": None}
    normal = {"state": "normal", "level": None}
    rows: list[dict[str, Any]] = [
        {"event": "raised"},
        {"event": "acknowledged", "acknowledged": {"by": "Ana"}},
        {"event": "ended", "change": "out of service", "out_of_service": what, "by": "Bo"} | normal,
        {"event": "ended", "change": "folded", "part_of": "line:hall"} | normal,
    ]
    at = {"since": "2026-11-20T12:00:00.5Z"}
    console = Console(width=160, file=io.StringIO(), color_system=None)
    with console.capture() as shown:
        console.print(past_view([plain | at | row for row in rows]))
    found = [re.split(" {2,}", line.strip()) for line in shown.get().splitlines()[1:]]
    assert [row[3:] for row in found] == [
        ["raised high", "active", "85 %", "too fast"],
        ["acknowledged", "active", "85 %", "Ana", "too fast"],
        ["out of service", "normal", "85 %", "Bo", "out of service by Bo: rebuilt"],
        ["folded", "normal", "85 %", "part of line:hall"],
    ]


def test_without_history_there_are_no_past_alarms(running: Path, command: Command) -> None:
    done = command("alarms", running, "--past", "1d")
    assert (done.code, "no history is kept here" in done.err) == (1, True), done.err


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--shelve", "mixer"], "with --by NAME"),
        (["--by", "Ana"], "give one of --ack"),
        (["--ack", "mixer", "--shelve", "mixer", "--by", "Ana"], "give one of --ack"),
        (["--shelve", "mixr", "--by", "Ana"], "no alarm mixr: did you mean mixer?"),
        (["--shelve", "mix*", "--by", "Ana"], "no alarm mix*"),
        (["--ack", "a#?b", "--by", "Ana"], "no alarm a#?b"),
        (["--shelve", "mixer", "--for", "2x", "--by", "Ana"], "x is no unit of time"),
        (["--shelve", "mixer", "--for", "2d", "--reason", "r", "--by", "Ana"], "has an end"),
        (["--shelve", "mixer", "--for", "2h", "--by", "Ana"], "the reason is missing"),
    ],
)
def test_a_wrong_order_is_a_mistake_of_the_user(
    running: Path, command: Command, options: list[str], why: str
) -> None:
    done = command("alarms", running, *options)
    assert (done.code, why in done.err) == (2, True), done.err
