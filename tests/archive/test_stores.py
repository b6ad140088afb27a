"""What every store promises: rows and cursor in one step, each row once, and exact values."""

import json
import random
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import psycopg
import pyarrow as pa
import pytest
from pyarrow import dataset
from pyarrow import parquet as pq

from gateway.archive import parquet
from gateway.archive.influx import InfluxStore
from gateway.archive.parquet import ParquetStore
from gateway.archive.postgres import PostgresStore
from gateway.archive.rows import Row, rfc3339, row_of
from gateway.archive.store import Cursor, Gap, Overtaken, Store, StoreDown, cursor_of
from gateway.archive.stores import store_at
from gateway.archive.turn import group_of
from gateway.bridges.documents import document_of
from gateway.errors import ConfigError
from tests.archive.servers import Postgres, postgres, s3
from tests.bridges.conftest import influxd as influxd
from tests.bridges.test_influx import Influx, failing_server
from tests.e2e.processes import ROOT

DEMO = "plant/@gateway/demo"
NOON = 1_795_694_400_000_000  # 2026-11-26T12:00:00Z
DAY = 86_400_000_000

VALUES: list[dict[str, Any]] = [
    {"value": 12.5, "quality": "good"},
    {"value": True, "quality": "good"},
    {"value": 2**64 - 1, "quality": "good"},
    {"value": 'A\t"B"\\\n', "quality": "good"},
    {"value": "", "quality": "good"},
    {"value": [1, 2.5], "quality": "good"},
    {"value": [2**63, 1], "quality": "good"},
    {"value": 3, "quality": "good", "text": "running"},
    {"value": 7, "quality": "good", "origin": "simulated", "limited": "high"},
    {"value": 99.5, "quality": "uncertain", "reason": "out-of-range"},
    {"value": None, "quality": "bad", "reason": "no-reply"},
]
ROWS = [
    row_of(f"plant/mixer/t{n}", {**known, "time": rfc3339(NOON + n)})
    for n, known in enumerate(VALUES)
]


def page(count: int, start: int = NOON, step: int = 1_000_000) -> list[Row]:
    return [
        Row(start + n * step, f"plant/mixer/t{n % 3}", n / 8, None, None, None, None, None)
        for n in range(count)
    ]


def after(cursor: Cursor, place: str, *, overlaps: bool = False) -> Cursor:
    return replace(cursor, after=f"demo:m-1-{place}", overlaps=overlaps)


@pytest.fixture(scope="module")
def server() -> Iterator[Postgres]:
    with postgres() as found:
        yield found


@pytest.fixture
def database(server: Postgres) -> Postgres:
    server.clear()
    return server


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with s3() as found:
        yield found


@pytest.fixture(params=["parquet", "s3", "postgres"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """A store that can be read back by `stored`."""
    if request.param == "parquet":
        yield ParquetStore(str(tmp_path / "archive"))
        return
    if request.param == "s3":
        bucket: str = request.getfixturevalue("bucket")
        yield ParquetStore(bucket.replace("/archive?", f"/{tmp_path.name}?"))
        return
    found = PostgresStore(request.getfixturevalue("database").address)
    yield found
    found.close()


def stored(store: Store) -> list[Row]:
    """Returns all rows as another program reads them."""
    columns = "key, value, text, elements, reason, origin, limited"
    if isinstance(store, PostgresStore):
        with psycopg.connect(store.address) as connection:
            query = f"SELECT extract(epoch FROM time) * 1000000, {columns} FROM plc_history"  # noqa: S608
            found = connection.execute(query.encode()).fetchall()
    else:
        assert isinstance(store, ParquetStore)
        files = dataset.dataset(store.root, filesystem=store.files, partitioning="hive")  # noqa: F841  (DuckDB finds it by its name)
        found = duckdb.execute(f"SELECT epoch_us(time), {columns} FROM files").fetchall()  # noqa: S608
    rows = [
        Row(int(at), key, value, text, None if some is None else tuple(some), *words)
        for at, key, value, text, some, *words in found
    ]
    return sorted(rows, key=lambda row: (row.time, row.key))


def test_every_kind_of_value_comes_back_exactly(store: Store) -> None:
    assert store.cursors() == {}
    begun = Cursor(DEMO)
    gap = Gap(None, rfc3339(NOON), "lost")
    cursor = store.add(ROWS, begun, after(begun, "11").with_gap(gap))
    assert stored(store) == ROWS
    assert (cursor.samples, cursor.newest, cursor.gaps) == (11, NOON + 10, (gap,))
    assert store.cursors() == {DEMO: cursor}
    assert [row.text for row in ROWS if row.key.endswith(("t2", "t6"))] == [
        str(2**64 - 1),
        f"[{2**63},1]",
    ]


def test_a_page_is_stored_only_after_the_one_before_it(store: Store) -> None:
    begun = Cursor(DEMO)
    first = store.add(page(3), begun, after(begun, "3"))
    for before in (begun, after(begun, "9")):
        with pytest.raises(Overtaken, match="demo"):
            store.add(page(3), before, after(before, "6"))
    second = store.add(page(4, NOON + DAY), first, after(first, "7"))
    assert second.samples == len(stored(store)) == 7


def test_another_file_of_the_gateway_adds_only_what_is_new(store: Store) -> None:
    """As after `history salvage`: samples come again, between others, and twice in one page."""
    begun, rows = Cursor(DEMO), page(50, NOON, DAY // 20)
    kept = [*ROWS, *rows[::2]]
    cursor = store.add(kept, begun, after(begun, "1"))
    changed = rows[0]._replace(value=77.0)  # of one time: another sample
    again = [*ROWS, *rows, rows[1], changed]
    random.Random(1).shuffle(again)
    cursor = store.add(again, cursor, after(cursor, "2", overlaps=True))
    assert cursor.samples == len(ROWS) + len(rows) + 1
    assert set(stored(store)) == {*ROWS, *rows, changed}
    assert len(stored(store)) == cursor.samples


def test_an_empty_page_moves_the_cursor(store: Store) -> None:
    begun = Cursor(DEMO)
    cursor = store.add([], begun, replace(after(begun, "1"), whole=NOON))
    assert store.cursors() == {DEMO: cursor}
    assert cursor.whole == NOON


# -- Parquet --


class Crash(OSError):
    """The process ends here."""


def test_a_crash_at_any_write_of_parquet_loses_and_doubles_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet, "PART", 40)
    choice, left = random.Random(7), 0
    put = ParquetStore._put

    def crashing(self: ParquetStore, path: str, data: object) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise Crash("killed")
        put(self, path, data)

    monkeypatch.setattr(ParquetStore, "_put", crashing)
    rows = [row for n in range(300) for row in page(1, NOON + choice.randrange(3) * DAY + n)]
    store, crashes, cursor, done = ParquetStore(str(tmp_path)), 0, Cursor(DEMO), 0
    while done < len(rows):
        left = choice.randrange(8)
        count = choice.randrange(1, 30)  # a page may end elsewhere when it is read again
        try:
            new = after(cursor, str(done + count))
            cursor = store.add(rows[done : done + count], cursor, new)
            done += count
        except StoreDown:
            crashes += 1
            left = 1000
            store = ParquetStore(str(tmp_path))
            cursor = store.cursors().get(DEMO, Cursor(DEMO))
            done = int(cursor.after.rpartition("-")[2] or 0)
    assert crashes > 20
    assert sorted(stored(store)) == sorted(rows)


def test_two_archivers_that_do_not_see_each_other_write_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other, begun = ParquetStore(str(tmp_path)), ParquetStore(f"{tmp_path}/"), Cursor(DEMO)
    append = one._append

    def beside(*arguments: Any) -> None:
        with pytest.raises(StoreDown, match="another archiver"):
            other.add(page(3), begun, after(begun, "3"))
        append(*arguments)

    monkeypatch.setattr(one, "_append", beside)
    one.add(page(3), begun, after(begun, "3"))
    with pytest.raises(Overtaken):
        other.add(page(3), begun, after(begun, "3"))
    assert len(stored(other)) == 3
    assert group_of(str(tmp_path)) == group_of(f"{tmp_path}/") == group_of(tmp_path.as_uri())


def test_parts_of_an_earlier_version_get_the_new_columns(tmp_path: Path) -> None:
    store = ParquetStore(str(tmp_path))
    begun = Cursor(DEMO)
    cursor = store.add(page(3), begun, after(begun, "3"))
    [part] = tmp_path.glob("date=2026-11-26/gateway=plant,demo/part-0000.parquet")
    old = pq.read_table(part, partitioning=None).drop_columns(["limited", "elements"])
    pq.write_table(old.append_column("later", pa.array(["kept"] * 3)), part)
    changed = row_of(
        "plant/mixer/t0",
        {"value": "now a text", "quality": "good", "time": rfc3339(NOON + DAY // 4)},
    )
    store.add([changed], cursor, after(cursor, "4"))
    assert stored(store) == sorted([*page(3), changed])
    assert pq.read_table(part, partitioning=None)["later"].to_pylist() == ["kept"] * 3 + [None]


def test_a_full_disk_is_told_and_the_page_comes_again(tmp_path: Path) -> None:
    (tmp_path / "archive").write_text("a file is in the way")
    store = ParquetStore(str(tmp_path / "archive"))
    with pytest.raises(StoreDown, match=r"[Dd]irectory|exist"):
        store.add(page(3), Cursor(DEMO), after(Cursor(DEMO), "3"))
    (tmp_path / "archive").unlink()
    store.add(page(3), Cursor(DEMO), after(Cursor(DEMO), "3"))
    assert stored(store) == page(3)


# -- PostgreSQL --


def test_a_killed_postgres_has_all_of_a_page_or_nothing(database: Postgres) -> None:
    store = PostgresStore(database.address)
    begun = Cursor(DEMO)
    cursor = store.add(page(3), begun, after(begun, "3"))
    database.kill()
    with pytest.raises(StoreDown):
        store.add(page(3, NOON + DAY), cursor, after(cursor, "6"))
    with pytest.raises(StoreDown):
        store.cursors()
    database.start()
    assert store.cursors() == {DEMO: cursor}
    store.add(page(3, NOON + DAY), cursor, after(cursor, "6"))
    assert len(stored(store)) == 6
    store.close()


# -- InfluxDB --


def test_influx_has_each_point_once_and_the_cursor(
    influxd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    influx = Influx(influxd, tmp_path)
    store, begun = InfluxStore(f"{influx.url}/write?db=plant"), Cursor(DEMO)
    with pytest.raises(StoreDown):
        store.cursors()
    with influx.run():
        assert store.cursors() == {}  # the database is not there yet
        with pytest.raises(StoreDown, match="404"):
            store.add(ROWS, begun, after(begun, "11"))
        influx.query("CREATE DATABASE plant")
        store.add(ROWS, begun, after(begun, "11"))
        cursor = store.add(ROWS, begun, after(begun, "11"))  # as after a crash
        assert store.cursors() == {DEMO: cursor}
        [[_, count]] = influx.query("SELECT count(good) FROM plc")
        assert count == len(ROWS)
        [[_, text]] = influx.query("SELECT text FROM plc WHERE \"name\"='t2'")
        assert text == str(2**64 - 1)
        monkeypatch.setattr("time.time_ns", lambda: NOON * 1000)  # the clock is set back
        other = InfluxStore(f"{influx.url}/write?db=plant")
        later = other.add([], other.cursors()[DEMO], after(cursor, "12"))
        assert other.cursors() == {DEMO: later}


def test_samples_that_influx_refuses_are_a_gap() -> None:
    begun = Cursor(DEMO)
    with failing_server([400, 204], []) as address:
        cursor = InfluxStore(address).add(ROWS, begun, after(begun, "11"))
    [gap] = cursor.gaps
    assert (gap.begin, gap.end) == (rfc3339(NOON), rfc3339(NOON + 10))
    assert "refused" in gap.why


# -- addresses, cursors, documents --


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("mysql://host/plant", "no store has an address with mysql://"),
        ("postgresql://host", "names no database"),
        ("postgresql://host/plant?nonsense=1", "nonsense"),
        ("http://host:8086/write", "names no database"),
        ("s3://", "s3://"),
    ],
)
def test_a_wrong_address_is_named(address: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        store_at(address)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"gaps": []}', '{"gaps": [1], "gateway": "x"}'])
def test_a_damaged_cursor_is_told(text: str) -> None:
    with pytest.raises(StoreDown, match="damaged"):
        cursor_of(text)


def test_what_is_no_sample_has_no_row() -> None:
    meta, document = {"type": "string[4]"}, json.dumps({"value": 1, "quality": "good"}).encode()
    assert document_of(meta, True, document, b"") is None  # no time
    about = b'{"quality": "good", "time": "2026-11-26T12:00:00Z"}'
    known = document_of(meta, True, b"12\0", about)
    assert known is not None
    assert row_of("plant/mixer/t", known)[:4] == (NOON, "plant/mixer/t", None, "12\ufffd")


@pytest.mark.parametrize("place", ["postgres", "parquet"])
def test_the_queries_of_the_page_work(
    place: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    text = (ROOT / "docs" / "archive.md").read_text("utf-8")
    query, *others = [
        block
        for block in re.findall(r"```sql\n(.*?)```", text, re.DOTALL)
        if ("read_parquet" in block) == (place == "parquet")
    ]
    begun = Cursor(DEMO)
    rows = [row._replace(key="plant/mixer/speed") for row in page(7200)]
    if place == "postgres":
        database: Postgres = request.getfixturevalue("database")
        store: Store = PostgresStore(database.address)
        store.add(rows, begun, after(begun, "1"))
        found = database.rows(query)
        [daily] = others
        assert [row[1:] for row in database.rows(daily)] == [("plant/mixer/speed", 449.9375)]
    else:
        store = ParquetStore(str(tmp_path))
        store.add(rows, begun, after(begun, "1"))
        found = duckdb.execute(query.replace("/srv/archive", str(tmp_path))).fetchall()
    store.close()
    assert [tuple(row)[1:] for row in found] == [
        ("plant/mixer/speed", 224.9375, 0.0, 449.875),
        ("plant/mixer/speed", 674.9375, 450.0, 899.875),
    ]
