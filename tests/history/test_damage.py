"""Flipped bits in the file: no wrong value, and no hole that nobody is told of."""

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange
from gateway.errors import Busy, Damaged
from gateway.parts.history.answers.recent import Recent
from gateway.parts.history.answers.search import Search
from gateway.parts.history.store.file import HistoryFile
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.schema import ForeignFile
from gateway.tags import Sample, Tag, good
from gateway.tags.recorded import RecordedQuery
from gateway.values import Value
from tests.history.recorded import (
    NOON,
    SECOND,
    all_runs,
    history,
    moved_aside,
    numbered,
    store_run,
)
from tests.history_writer import tag, until

ALWAYS = TimeRange(EARLIEST, LATEST)
TAGS = [tag(f"t{n}") for n in range(7)]
EVERYTHING = RecordedQuery({tag.key: tag for tag in TAGS}, "", None, 0)
FLIPS = 60
CONTENT: list[Value] = [1, 2.5, "text", True, 2**63, -7]

Answer = tuple[set[tuple[str, int, Value | None]], bool]  # samples, and whether damage was told


def recorded(path: Path) -> set[tuple[str, int, Value | None]]:
    samples = [good(TAGS[n % 7], CONTENT[n % 6], NOON + n * SECOND) for n in range(1200)]
    with closing(HistoryFile(path, 10**8)) as file:
        for run in range(3):
            store_run(file, samples[run * 400 : (run + 1) * 400])
        file.empty_log()
    return set(map(_shown, samples))


def _shown(sample: Sample) -> tuple[str, int, Value | None]:
    return sample.tag.key, sample.time, sample.value


def answers(path: Path) -> Iterator[Answer]:
    """Opens the file as a gateway does. Yields the answers to a query for all tags and for each."""
    with closing(HistoryFile(path, 10**8)) as file:
        recent = Recent(1000, 600)
        recent.opened(file.identity, (), file.extent, file.next_number())
        recent.set_sorted(all_runs(file))
        reader = Reader(path)
        search = Search(recent, reader)
        try:
            yield _all(search)
            yield _one_by_one(search)
        finally:
            reader.renew()


def _all(search: Search) -> Answer:
    found, told = set[tuple[str, int, Value | None]](), False
    for sample, _ in search.as_recorded(EVERYTHING, ALWAYS, lambda: None):
        if isinstance(sample, Damaged):
            told = True
        elif not isinstance(sample, bool):
            found.add(_shown(sample))
    return found, told


def _one_by_one(search: Search) -> Answer:
    found, told = set[tuple[str, int, Value | None]](), False

    def one(tag: Tag) -> Iterator[Sample]:
        nonlocal told
        try:
            yield from search.by_time(tag, ALWAYS)
        except Damaged:
            told = True

    for each in TAGS:
        found.update(map(_shown, one(each)))
    return found, told


def test_a_flipped_bit_is_told_or_harmless(tmp_path: Path) -> None:
    path, chance = tmp_path / "h.db", random.Random(11)
    expected = recorded(path)
    whole = path.read_bytes()
    assert list(answers(path)) == [(expected, False)] * 2
    told_of = 0
    for _ in range(FLIPS):
        place, bit = chance.randrange(len(whole)), 1 << chance.randrange(8)
        path.write_bytes(whole[:place] + bytes([whole[place] ^ bit]) + whole[place + 1 :])
        for tail in ("-wal", "-shm"):
            Path(f"{path}{tail}").unlink(missing_ok=True)
        try:
            for found, told in answers(path):
                assert found <= expected, place
                assert told or found == expected, place
                told_of += told
        except (sqlite3.Error, UnicodeDecodeError, ForeignFile, Busy, Damaged):
            continue  # the file is moved aside, or the answer is an error
    assert told_of > FLIPS / 4


@pytest.mark.parametrize(
    "change",
    [
        "CREATE TRIGGER no BEFORE INSERT ON sample BEGIN SELECT RAISE(ABORT, 'no'); END",
        "CREATE TRIGGER gone AFTER INSERT ON sample BEGIN DELETE FROM sample; END",
        "CREATE UNIQUE INDEX one ON sample (id)",
        "ALTER TABLE run ADD COLUMN more",
        "DROP TABLE written",
    ],
)
def test_a_file_with_another_schema_is_moved_aside_and_recording_goes_on(
    tmp_path: Path, change: str
) -> None:
    path = tmp_path / "h.db"
    recorded(path)
    with closing(sqlite3.connect(path)) as database:
        database.executescript(change)
    with history(path) as historian:
        historian.record(numbered(20))
        document = until(historian, state="ok", stored=20)
    assert (len(moved_aside(tmp_path)), len(document["aside"])) == (1, 1)


def test_a_view_of_a_person_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    recorded(path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE VIEW mine AS SELECT * FROM sample")
    with closing(HistoryFile(path, 10**8)) as file:
        assert file.next_number() > 1000
    assert moved_aside(tmp_path) == []


@pytest.mark.parametrize(
    "damage",
    [
        "DELETE FROM sample WHERE id = 407",
        "UPDATE sample SET value = 3 WHERE id = 407",
        "UPDATE sample SET tag = 3 WHERE id = 408",
        "UPDATE tag SET key = 'mixer/other' WHERE id = 3",
        "DELETE FROM tag WHERE id = 7",
    ],
)
def test_a_lost_or_changed_row_is_told(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "h.db"
    expected = recorded(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(damage)
    for found, told in answers(path):
        assert told
        assert found < expected


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE run SET last = first WHERE id = 401",
        "UPDATE run SET samples = 'many' WHERE id = 401",
        "DELETE FROM run WHERE id = 401",
        "DELETE FROM run",
        "UPDATE run SET places = zeroblob(length(places)) WHERE id = 401",
        "UPDATE run SET places = substr(places, 1, length(places) - 2) WHERE id = 401",
    ],
)
def test_a_damaged_list_of_runs_costs_no_sample(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "h.db"
    expected = recorded(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(damage)
    assert list(answers(path)) == [(expected, False)] * 2


def test_a_page_that_cannot_be_read_costs_only_its_samples(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=5_000_000) as historian:
        historian.record(numbered(30_000))
    with history(path, max_size=5_000_000):
        pass  # all runs are sorted now
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        [(page,)] = database.execute(
            "SELECT pageno FROM dbstat WHERE name = 'sample' AND pagetype = 'leaf'"
            " ORDER BY path LIMIT 1 OFFSET 50"
        )
    with path.open("r+b") as file:
        file.seek((page - 1) * 4096)
        file.write(b"\xa5" * 4096)
    with history(path, max_size=5_000_000) as historian:
        found = list[Value | None]()
        with pytest.raises(Damaged, match="are lost"):
            found.extend(s.value for s in historian.samples(numbered(1)[0].tag, "[..]", None))
        assert found == sorted(set(range(30_000)) & set(found))
        assert 29_000 < len(found) < 30_000
        assert "damaged" in str(historian.document()["state"])


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE file SET oldest = 9223372036854775807",
        "UPDATE file SET oldest = 'x'",
        "UPDATE file SET tags = 9223372036854775807",
        "DELETE FROM file",
        "INSERT INTO file SELECT * FROM file",
        "UPDATE sample SET id = 9223372036854775806 WHERE id = 1200",
        "UPDATE run SET id = 9223372036854775806 WHERE id = 801",
    ],
)
def test_numbers_that_no_gateway_has_given_are_damage(tmp_path: Path, damage: str) -> None:
    """A search for what they count would never end, and every start would fail again."""
    path = tmp_path / "history.db"
    recorded(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(damage)
    with pytest.raises(Damaged):
        HistoryFile(path, 10**8)
