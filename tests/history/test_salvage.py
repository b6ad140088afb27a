"""A history that was moved aside: a fault until a person knows, and its samples come back."""

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from gateway.contract.faults import faults
from gateway.errors import GatewayError
from gateway.parts.history.files.aside import asides, rename
from gateway.parts.history.files.offline import salvage
from gateway.tags import good
from tests.history.recorded import (
    EVERYTHING,
    NOON,
    SPEED,
    history,
    is_intact,
    moved_aside,
    numbered,
    record_outcome,
    values,
    write,
    written,
)
from tests.history_writer import tag, until

NAME, LONG = tag("name"), tag("long")
TEXT = "x" * 20_000  # on several pages


def damaged(path: Path, page: int, pages: int = 1) -> None:
    with path.open("r+b") as file:
        file.seek((page - 1) * 4096)
        file.write(b"\xa5" * 4096 * pages)


def recorded(path: Path) -> int:
    """Returns the number of pages."""
    with history(path) as historian:
        historian.record(numbered(20_000))
        historian.record([good(NAME, "n", NOON + 5), good(LONG, TEXT, NOON + 6)])
        record_outcome(historian, write(1))
        until(historian, waiting=0, writes_stored=1)
    return path.stat().st_size // 4096


def root(path: Path, table: str) -> int:
    with closing(sqlite3.connect(path)) as database:
        query = "SELECT rootpage FROM sqlite_schema WHERE name = ?"
        [(number,)] = database.execute(query, (table,))
    return int(number)


@pytest.mark.parametrize("place", ["first", "sample", "leaf"])
def test_sound_samples_come_back_before_those_of_the_new_file(tmp_path: Path, place: str) -> None:
    path = tmp_path / "h.db"
    pages = recorded(path)
    table = root(path, "sample")
    damaged(path, {"first": 1, "sample": table, "leaf": pages // 2}[place])
    if place == "leaf":
        path.rename(tmp_path / "h.db.aside-20261121T120000.0Z")
    with history(path) as historian:
        historian.record(numbered(10, 30_000))
        until(historian, waiting=0)
        assert len(asides(path)) == 1
        [fault] = faults({"history": historian.document()})
        assert "was moved aside" in fault
        with pytest.raises(GatewayError, match="stop the gateway"):
            salvage(path)
    with history(path) as historian:  # a fault after a restart too
        assert len(historian.document()["aside"]) == 1
    back = salvage(path)
    assert is_intact(path)
    with history(path) as historian:
        assert historian.document()["aside"] == []
        found = values(historian)
        assert found[-10:] == list(range(30_000, 30_010))
        if place == "leaf":
            assert 19_000 < len(found) <= 20_010
            assert set(found) < {*range(20_000), *range(30_000, 30_010)}
            assert values(historian, LONG) == [TEXT]
            assert written(historian) == [1]
        else:  # every sample that is on one page
            assert found == [*range(20_000), *range(30_000, 30_010)]
        assert values(historian, NAME) == ["n"]
        assert back == len(found) - 10 + 1 + len(values(historian, LONG))
    assert moved_aside(tmp_path) == []
    assert len([*tmp_path.glob("h.db.salvaged-*Z")]) == 1
    assert len([*tmp_path.glob("h.db.replaced-*Z")]) == 1
    assert not [*tmp_path.glob("*salvaging*")]


def test_random_damage_never_brings_back_a_wrong_sample(tmp_path: Path) -> None:
    path, chance = tmp_path / "h.db", random.Random(3)
    recorded(path)
    whole = bytearray(path.read_bytes())
    for _ in range(2000):
        whole[chance.randrange(len(whole))] = chance.randrange(256)
    (tmp_path / "h.db.aside-20261121T120000.0Z").write_bytes(whole)
    path.unlink()
    salvage(path)
    with history(path) as historian:
        found = [(s.time, s.value) for s in historian.samples(SPEED, EVERYTHING, None)]
    expected = {(sample.time, sample.value) for sample in numbered(20_000)}
    assert set(found) < expected
    assert len(found) == len(set(found)) > 5000


FIRST_FORMAT = """
CREATE TABLE tag (id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE);
CREATE TABLE recent (run, n, tag, time, value, kind, bad, PRIMARY KEY (run, n)) WITHOUT ROWID;
CREATE TABLE sample (
    run, tag, time, n, value, kind, bad, PRIMARY KEY (run, tag, time, n)
) WITHOUT ROWID;
CREATE TABLE written (id INTEGER PRIMARY KEY, time INTEGER, outcome TEXT);
INSERT INTO tag VALUES (1, 'mixer/speed');
INSERT INTO sample VALUES (1, 1, 1795262400000000000, 0, 5, NULL, NULL);
INSERT INTO recent VALUES (2, 0, 1, 1795262401000000000, NULL, NULL, 'no-reply');
PRAGMA application_id = 0x706C6368;
PRAGMA user_version = 1;
"""


def test_a_history_of_an_earlier_version_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with closing(sqlite3.connect(path)) as database:
        database.executescript(FIRST_FORMAT)
    with history(path):
        assert len(moved_aside(tmp_path)) == 1
    assert salvage(path) == 2
    with history(path) as historian:
        assert values(historian) == [5, None]


def test_a_known_file_is_no_fault_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    path.write_bytes(b"no database")
    with history(path) as historian:
        [aside] = asides(path)
        rename(aside, "known")
        until(historian, aside=[])
        assert [*faults({"history": historian.document()})] == []
    assert len([*tmp_path.glob("h.db.known-*Z")]) == 1
    with pytest.raises(GatewayError, match="no file beside"):
        salvage(path)
