"""The command `alarms` at a running gateway: shelving, and what its lists show."""

import json
import re
from pathlib import Path

import pytest

from tests.cli.conftest import Command


def test_an_alarm_is_shelved_listed_and_put_back(running: Path, command: Command) -> None:
    def told(*options: str) -> str:
        return command("alarms", running, *options, "--by", "Ana").out.strip()

    shelved = r"shelved until \d{4}-\S+ \S+ by Ana: being repaired"
    shelve = "--shelve", "mixer", "--for", "2h", "--reason", "being repaired"
    assert re.fullmatch(f"mixer: {shelved}", told(*shelve))
    [row] = command("alarms", running).out.splitlines()[1:]
    assert re.fullmatch(rf"mixer +high +shelved .*{shelved}\s*", row)
    [document] = json.loads(command("alarms", running, "--json").out)
    assert document["shelved"]["reason"] == "being repaired"
    assert re.search(r"^alarms +1 shelved *$", command("status", running).out, re.MULTILINE)
    assert told("--unshelve", "mixer") == "mixer: normal"
    removed = "--out-of-service", "mixer", "--reason", "rebuilt"
    assert told(*removed) == "mixer: out of service by Ana: rebuilt"
    assert told("--in-service", "mixer") == "mixer: normal"
    assert told("--ack", "*") == "0 of 0 alarms acknowledged"
    assert command("alarms", running).out.strip() == "no alarms"


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--shelve", "mixer"], "with --by NAME"),
        (["--by", "Ana"], "give one of --ack"),
        (["--ack", "mixer", "--shelve", "mixer", "--by", "Ana"], "give one of --ack"),
        (["--shelve", "mixr", "--by", "Ana"], "no alarm mixr"),
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
