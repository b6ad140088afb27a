"""`history export`: samples and buckets of the file, also without a gateway."""

import csv
import io
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest

from gateway.cli.history.history_files import Column, write_csv
from gateway.parts.history.store.file import HistoryFile
from gateway.tags import Reason, bad, good
from tests.conftest import Command
from tests.e2e.processes import vigor_line, write_config
from tests.history.recorded import NOON, SECOND, store_run
from tests.history_writer import tag

HOUR = "[2026-11-21T12:00:00Z..2026-11-21T12:00:40Z["
EXPORTED = """\
time,tag,value,quality,reason,origin,limited
2026-11-21T12:00:00.000000Z,mixer/speed,5.5,good,,,
2026-11-21T12:00:10.000000Z,mixer/speed,,bad,no-reply,,
2026-11-21T12:00:15.000000Z,mixer/name,"A, B",good,,,
2026-11-21T12:00:20.000000Z,mixer/speed,18446744073709551615,good,,,
2026-11-21T12:00:25.000000Z,mixer/name,,bad,no-reply,,
2026-11-21T12:00:25.000000Z,mixer/steps,"[1, 2.5]",good,,,
"""
BUCKETS = """\
time;tag;quality;mean;last;good;bad;known;reason;origin
2026-11-21T12:00:00.000000Z;mixer/speed;partial;5,5;5,5;1;1;10,0;no-reply;
2026-11-21T12:00:20.000000Z;mixer/speed;partial;1,8446744073709552e+19;18446744073709551615;1;0;5,0;\
not-recorded;
2026-11-21T12:00:00.000000Z;mixer/name;partial;;A, B;1;0;5,0;not-recorded;
2026-11-21T12:00:20.000000Z;mixer/name;partial;;A, B;0;1;5,0;no-reply;
2026-11-21T12:00:00.000000Z;mixer/steps;bad;;;0;0;0,0;not-recorded;
2026-11-21T12:00:20.000000Z;mixer/steps;partial;;[1, 2.5];1;0;0,0;not-recorded;
"""


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("gateway.cli.history.history._wall", lambda: NOON + 3600 * SECOND)
    speed, name, other = tag("speed"), tag("name"), tag("other")
    samples = [
        good(speed, 5.5, NOON),
        bad(speed, Reason.NO_REPLY, NOON + 10 * SECOND),
        good(name, "A, B", NOON + 15 * SECOND),
        good(speed, 2**64 - 1, NOON + 20 * SECOND),
        bad(name, Reason.NO_REPLY, NOON + 25 * SECOND),
        good(other, 1, NOON + 25 * SECOND),  # not in the configuration
        good(tag("steps"), (1, 2.5), NOON + 25 * SECOND),
    ]
    with closing(HistoryFile(tmp_path / "history.db", 10**8)) as file:
        store_run(file, samples[:2])
        file.store(3, samples[2:])  # as a killed gateway leaves it
    tags = {
        "speed": {"address": "D10"},
        "name": {"address": "D600", "type": "string[8]"},
        "steps": {"address": "D20", "type": "float32[2]"},
    }
    lines = {"hall": vigor_line("/dev/ttyUSB0", tags)}
    where = {"path": str(tmp_path / "history.db")}
    return write_config(tmp_path / "plant.yaml", "tcp/127.0.0.1:0", lines, history=where)


def test_samples_are_printed_as_csv(config: Path, command: Command) -> None:
    done = command("history", "export", config, "--time", HOUR)
    assert (done.code, done.out, done.err) == (0, EXPORTED, "")
    only = command("history", "export", config, "mixer/name", "--quality", "good", "--time", HOUR)
    assert only.out.splitlines()[1:] == [EXPORTED.splitlines()[3]]


def test_many_buckets_go_into_a_new_file(config: Path, command: Command, tmp_path: Path) -> None:
    file = tmp_path / "out.csv"
    all_day = ("--time", "[..]", "--bucket", "100ms")
    done = command("history", "export", config, "mixer/speed", *all_day, "--output", file)
    assert done.code == 0
    assert len(file.read_text().splitlines()) == 1 + 36_000
    again = command("history", "export", config, "--output", file)
    assert (again.code, "exists: name a new file" in again.err) == (2, True)
    assert not list(tmp_path.glob("*.unfinished"))


def test_no_link_that_waits_is_followed(
    config: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, file = tmp_path / "other", tmp_path / "out.csv"
    other.write_text("kept")
    (tmp_path / "out.csv.unfinished").symlink_to(other)
    file.symlink_to(tmp_path / "missing")
    assert command("history", "export", config, "--time", HOUR, "--output", file).code == 0
    assert (other.read_text(), file.read_text()) == ("kept", EXPORTED)
    assert not file.is_symlink()
    monkeypatch.setattr("gateway.cli.history.history_files.token_hex", lambda _: "known")
    (tmp_path / "more.csv.known.unfinished").symlink_to(other)
    done = command("history", "export", config, "--output", tmp_path / "more.csv")
    assert (done.code, other.read_text()) == (2, "kept")


def test_a_recorded_text_is_no_formula_in_a_spreadsheet() -> None:
    texts = ["=cmd|' /C calc'!A0", "+1", "-1", "@A1", "\t=1", "\r=1", "'", "A, B"]
    stream = io.StringIO(newline="")
    rows = [(text,) for text in [*texts, -1, -1.5]]
    write_csv(stream, [Column("value", "value")], rows, comma=False)
    found = [row[0] for row in csv.reader(io.StringIO(stream.getvalue(), newline=""))][1:]
    assert found == [*("'" + text for text in texts[:-1]), "A, B", "-1", "-1.5"]


def test_buckets_with_decimal_commas(config: Path, command: Command) -> None:
    some = ("--agg", "mean,last", "--decimal-comma")
    done = command("history", "export", config, "--time", HOUR, "--bucket", "20s", *some)
    assert (done.code, done.out) == (0, BUCKETS)


def test_parquet_has_the_same_rows(config: Path, command: Command, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    file = tmp_path / "out.parquet"
    assert command("history", "export", config, "--time", HOUR, "--output", file).code == 0
    rows = parquet.read_table(file).to_pylist()
    assert [(row["tag"], row["value"], row["text"], row["quality"]) for row in rows] == [
        ("mixer/speed", 5.5, None, "good"),
        ("mixer/speed", None, None, "bad"),
        ("mixer/name", None, "A, B", "good"),
        ("mixer/speed", 2.0**64, "18446744073709551615", "good"),
        ("mixer/name", None, None, "bad"),
        ("mixer/steps", None, "[1, 2.5]", "good"),
    ]
    assert rows[0]["time"].isoformat() == "2026-11-21T12:00:00+00:00"


@pytest.mark.parametrize(
    ("options", "code", "sentence"),
    [
        (["--bucket", "1sec"], 2, "bucket=1sec is no duration such as 10s, 1min or 1h"),
        (["--time", "yesterday"], 2, "is no range such as"),
        (["--output", "out.ods"], 2, "out.ods: the name must end with .csv or .parquet"),
        (["--history", "missing.db"], 1, "there is no history missing.db"),
        (["mixer/sped"], 2, "there is no tag or device mixer/sped: did you mean mixer/speed?"),
    ],
)
def test_mistakes(
    config: Path, command: Command, options: list[str], code: int, sentence: str
) -> None:
    done = command("history", "export", config, *options)
    assert (done.code, done.out) == (code, "")
    assert sentence in done.err


def test_without_pyarrow_the_package_is_named(
    config: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = command("history", "export", config, "--output", "out.parquet")
    assert done.code == 2
    assert "pip install pyarrow" in done.err


def test_lost_samples_are_told_and_all_others_exported(
    config: Path, command: Command, tmp_path: Path
) -> None:
    with closing(sqlite3.connect(tmp_path / "history.db")) as file:
        file.execute("UPDATE sample SET value = 7 WHERE value = 5.5")
        file.commit()
    done = command("history", "export", config, "--time", HOUR)
    assert done.code == 1
    assert "are lost: the file is damaged there; all others were exported" in done.err
    assert done.out.splitlines()[1:] == EXPORTED.splitlines()[2:]


def test_a_history_that_was_moved_aside_is_salvaged_or_known(
    config: Path, command: Command, tmp_path: Path
) -> None:
    before = command("history", "export", config, "--time", HOUR)
    for word in ("salvage", "known"):
        done = command("history", word, config)
        assert (done.code, "was moved aside" in done.err) == (1, True)
    (tmp_path / "history.db").rename(tmp_path / "history.db.aside-20261121T120000.0Z")
    done = command("history", "salvage", config)
    assert (done.code, "7 samples are back" in done.err) == (0, True)
    assert command("history", "export", config, "--time", HOUR) == before
    (tmp_path / "history.db").rename(tmp_path / "history.db.aside-20261121T130000.0Z")
    assert command("history", "known", config).code == 0
    assert len([*tmp_path.glob("history.db.known-*Z")]) == 1
