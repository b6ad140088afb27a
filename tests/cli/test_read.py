"""The `read` command through the running gateway, and the tags that `read` and `watch` accept."""

from pathlib import Path

import pytest

from tests.cli.conftest import TAGS, documents
from tests.conftest import Command


@pytest.mark.parametrize("name", ["read", "watch"])
@pytest.mark.parametrize("direct", [[], ["--direct"]])
@pytest.mark.parametrize(
    ("tag", "says"),
    [
        ("mixer/sped", "there is no tag or device mixer/sped"),
        ("oven", "there is no tag or device oven"),
        ("oven/**", "there is no tag or device oven/**"),
        ("mixer/**/", "mixer/**/ is not a tag, and not a wildcard like 'mixer/**'"),
        ("mixer/speed?max_age=0s", "is not a tag"),
    ],
)
def test_an_unknown_tag_ends_with_2(
    command: Command, config: Path, name: str, direct: list[str], tag: str, says: str
) -> None:
    if name == "watch" and direct:
        direct = []
    done = command(name, config, tag, *direct)
    assert (done.code, done.out) == (2, "")
    assert says in done.err


def test_a_max_age_that_is_not_a_duration_ends_with_2(command: Command, config: Path) -> None:
    done = command("read", config, "--max-age", "soon")
    assert (done.code, done.out) == (2, "")
    assert "max_age=soon is no duration" in done.err


def test_read_prints_a_table(command: Command, running: Path) -> None:
    done = command("read", running)
    assert done.code == 0
    header, *rows = done.out.splitlines()
    assert header.split() == ["tag", "value", "unit", "quality", "time"]
    assert [row.split()[0] for row in rows] == sorted(f"mixer/{name}" for name in TAGS)
    assert [row.split()[2:5] for row in rows if row.startswith("mixer/speed")] == [
        ["rpm", "good,", "simulated"]
    ]


def test_read_as_json_prints_one_document_per_line(command: Command, running: Path) -> None:
    text = "x" * 128  # a line longer than any terminal
    assert command("write", running, "mixer/name", text).code == 0
    asked = ("read", running, "mixer/name", "mixer/run", "--json", "--max-age", "0s")
    done = command(*asked)
    while done.code and "no-reply" in done.out:  # a simulated reply is late on a busy machine
        done = command(*asked)
    assert done.code == 0, done
    name, run = documents(done.out)
    assert (name["tag"], name["value"], name["quality"]) == ("mixer/name", text, "good")
    assert (run["tag"], run["quality"]) == ("mixer/run", "good")


@pytest.mark.parametrize("tags", [[], ["mixer"], ["mixer/run", "mixer/new"]])
def test_read_names_tags_without_a_reply_and_ends_with_1(
    command: Command, newer: Path, tags: list[str]
) -> None:
    done = command("read", newer, *tags, "--json")
    assert done.code == 1
    assert "mixer/run" in [row["tag"] for row in documents(done.out)]
    assert done.err == (
        "no reply for mixer/new: does the gateway run with the current version of this file?\n"
    )
