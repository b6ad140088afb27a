"""`--json` of commands that need no running gateway: the fields of docs/commands.md."""

import json
from contextlib import closing
from pathlib import Path

import pytest

from gateway.contract.documents.catalogue import FILE
from gateway.parts.history.store.file import HistoryFile
from gateway.tags import good
from tests.cli.conftest import documents
from tests.conftest import Command
from tests.contract.reader import Reader
from tests.e2e.processes import vigor_line, write_config
from tests.e2e.test_served_recording import LOG
from tests.history.recorded import NOON, store_run
from tests.history_writer import tag

SAMPLE = {"time", "tag", "value", "quality", "reason", "origin", "limited"}
BUCKET = {
    "time",
    "tag",
    "quality",
    "min",
    "max",
    "mean",
    "last",
    "good",
    "bad",
    "known",
    "reason",
    "origin",
}
SENT = {"way", "sent", "why"}
ALL_DAY = ("--time", "[2026-11-21T00:00:00Z..2026-11-22T00:00:00Z[")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A file with a history of one sample and two ways to people, and a recording."""
    with closing(HistoryFile(tmp_path / "history.db", 10**8)) as file:
        store_run(file, [good(tag("speed"), 5.5, NOON)])
    write_config(
        tmp_path / "plant.yaml",
        "tcp/127.0.0.1:0",
        {"hall": vigor_line("/dev/ttyUSB0", {"speed": {"address": "D10"}})},
        history={"path": str(tmp_path / "history.db")},
        notify={
            "command": ["/bin/true"],
            "webhook": {"url": "http://127.0.0.1:1/"},
            "rules": [{"to": ["command", "webhook"]}],
        },
    )
    (tmp_path / "hall.log").write_text(LOG)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "code", "fields", "rows"),
    [
        (["history", "export", "plant.yaml", *ALL_DAY], 0, SAMPLE, 1),
        (["history", "export", "plant.yaml", *ALL_DAY, "--bucket", "12h"], 0, BUCKET, 2),
        (["notify", "plant.yaml", "command"], 0, SENT, 1),
        (["notify", "plant.yaml"], 1, SENT, 2),
        (["replay", "hall.log"], 0, {"tag"}, 2),
        (["replay", "hall.log", "--protocol", "vigor"], 1, set(), 0),
        (["history", "export", "plant.yaml", "--output", "x.csv"], 2, set(), 0),
    ],
)
def test_each_row_is_a_document_with_the_fields_of_the_page(
    command: Command,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    fields: set[str],
    rows: int,
) -> None:
    monkeypatch.chdir(folder)
    done = command(*arguments, "--json")
    found = documents(done.out)
    assert (done.code, len(found)) == (code, rows), done.err
    assert bool(done.err) is (not rows)  # a way that failed is in its row
    for row in found:
        if fields == {"tag"}:
            row.pop("tag")
            reader = Reader(json.loads(FILE.read_text("utf-8")), "plant")
            assert reader.violations("value", row) == []
        else:
            assert {*row} == fields
    if rows and fields == SENT:
        assert [one["sent"] for one in found] == [True, False][:rows]
        assert [bool(one["why"]) for one in found] == [False, True][:rows]
