"""What the archive carries: `python -m benchmarks.archive`.

* Rows into each store: pages of 10,000 samples, as the archiver stores them.
* Back-fill: a gateway with a history serves it to `archive run` while it publishes live values to a
  subscriber; how late those are, without and with the back-fill.
* Queries: a month of 100 gateways in the store; the daily means of all tags of one gateway, the
  hourly extremes of one tag, and a count of everything.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import duckdb
import psycopg
import zenoh

from gateway.archive.parquet import ParquetStore
from gateway.archive.postgres import PostgresStore
from gateway.archive.rows import Row
from gateway.archive.store import Cursor, Store
from gateway.parts.history.store.file import HistoryFile
from gateway.tags import good
from tests.archive.servers import postgres
from tests.e2e.processes import gateway, started, vigor_line, write_config
from tests.history.recorded import store_run
from tests.history_writer import tag
from tests.zenoh_peer import configured, free_endpoint

PAGE = 10_000
MONTH = 30 * 86_400 * 10**6  # microseconds
BEGIN = 1_793_491_200_000_000  # 2026-11-01
TAGS = 20  # of each gateway
RUN = 30_000  # samples of a run of the history
MOVING = {"now": {"address": "D900"}}  # not in the history


def pages(name: int, count: int) -> Iterator[list[Row]]:
    """Yields a month of a gateway: a value of each tag in turn, one of a hundred bad."""
    step = MONTH // count
    for first in range(0, count, PAGE):
        yield [
            Row(
                BEGIN + n * step,
                f"plant/g{name}/t{n % TAGS}",
                None if n % 100 == 99 else n % 977 / 8,
                None,
                None,
                "no-reply" if n % 100 == 99 else None,
                None,
                None,
            )
            for n in range(first, min(first + PAGE, count))
        ]


def fill(store: Store, gateways: int, samples: int) -> float:
    """Stores a month of all gateways; returns the rows a second within the store alone."""
    took = 0.0
    for name in range(gateways):
        cursor = Cursor(f"plant/@gateway/g{name}", overlaps=False)
        for number, rows in enumerate(pages(name, samples // gateways)):
            begun = time.perf_counter()
            cursor = store.add(rows, cursor, replace(cursor, after=f"g{name}:m-1-{number}"))
            took += time.perf_counter() - begun
    return samples // gateways * gateways / took


QUERIES = {
    "daily means of the tags of one gateway": (
        "SELECT {day} AS day, key, avg(value) FROM {table}"
        " WHERE key LIKE 'plant/g7/%' AND quality = 'good' {of_gateway} GROUP BY 1, 2"
    ),
    "hourly extremes of one tag": (
        "SELECT {hour} AS hour, min(value), max(value) FROM {table}"
        " WHERE key = 'plant/g7/t3' AND quality = 'good' {of_gateway} GROUP BY 1"
    ),
    "daily means of all tags of all gateways": (
        "SELECT {day} AS day, key, avg(value) FROM {table} WHERE quality = 'good' GROUP BY 1, 2"
    ),
}
OF_POSTGRES = {
    "the same, by the number of the tag": (
        "SELECT day, key, mean FROM (SELECT date_trunc('day', time) AS day, tag, avg(value) AS mean"
        " FROM plc_sample WHERE reason IS NULL GROUP BY 1, 2) AS daily JOIN plc_tag ON id = tag"
    ),
}


def queries(run: Callable[[str], Sequence[Any]], wanted: dict[str, str], **words: str) -> None:
    for name, query in wanted.items():
        begun = time.perf_counter()
        rows = run(query.format(**words))
        print(f"  {name}: {len(rows)} rows in {time.perf_counter() - begun:.2f} s", flush=True)


@contextmanager
def parquet_store() -> Iterator[tuple[Store, Callable[[], None]]]:
    with tempfile.TemporaryDirectory() as name:

        def ask() -> None:
            files = f"read_parquet('{name}/*/*/*.parquet', hive_partitioning = true)"
            size = sum(path.stat().st_size for path in Path(name).rglob("*.parquet"))
            print(f"  {size / 1e6:.0f} MB", flush=True)
            queries(
                lambda query: duckdb.execute(query).fetchall(),
                QUERIES,
                table=files,
                day="date",
                hour="date_trunc('hour', time)",
                of_gateway="AND gateway = 'plant,g7'",
            )

        yield ParquetStore(name), ask


@contextmanager
def postgres_store() -> Iterator[tuple[Store, Callable[[], None]]]:
    with postgres() as server:

        def ask() -> None:
            with psycopg.connect(server.address, autocommit=True) as connection:
                connection.execute("VACUUM ANALYZE plc_sample")  # autovacuum does it in time
                [(size,)] = connection.execute("SELECT pg_database_size('plant')").fetchall()
            print(f"  {size / 1e6:.0f} MB", flush=True)
            queries(
                server.rows,
                QUERIES | OF_POSTGRES,
                table="plc_history",
                day="date_trunc('day', time)",
                hour="date_trunc('hour', time)",
                of_gateway="",
            )

        store = PostgresStore(server.address)
        yield store, ask
        store.close()


# -- back-fill --


def opened(endpoint: str) -> zenoh.Session:
    """Opens a client's session."""
    return zenoh.open(
        configured({"mode": "client", "listen": [], "connect": [endpoint], "config": {}})
    )


class Lateness:
    """Notes how late each live value arrives."""

    def __init__(self, session: zenoh.Session) -> None:
        self.seconds: list[float] = []
        self._subscriber = session.declare_subscriber("plant/**", self._arrived)

    def _arrived(self, sample: zenoh.Sample) -> None:
        known = json.loads(sample.payload.to_bytes())
        sent = datetime.fromisoformat(known["time"])
        self.seconds.append((datetime.now(UTC) - sent).total_seconds())

    def shown(self) -> str:
        found, self.seconds = sorted(self.seconds), []
        p50, p99 = (found[int(len(found) * part)] * 1000 for part in (0.5, 0.99))
        return f"{len(found)} live values, late by p50 {p50:.0f} ms, p99 {p99:.0f} ms"


def write_history(path: Path, samples: int) -> None:
    """A week until now, of the tags in turn."""
    tags = [tag(f"t{n}").with_origin("simulated") for n in range(TAGS)]
    begin, step = time.time_ns() - 7 * 86400 * 10**9, 7 * 86400 * 10**9 // samples
    with closing(HistoryFile(path, 10**10)) as file:
        for first in range(0, samples, RUN):
            numbers = range(first, min(first + RUN, samples))
            store_run(file, [good(tags[n % TAGS], n, begin + n * step) for n in numbers])


def back_fill(samples: int, rate: int, seconds: float) -> None:
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as name, ExitStack() as ends:
        folder = Path(name)
        write_history(folder / "h.db", samples)
        tags = {f"t{n}": {"address": f"D{n}", "history": True} for n in range(TAGS)}
        lines = {"hall": vigor_line("simulator", tags | MOVING)}
        how = {"history": {"path": "h.db", "keep": "3650d", "max_size": "10GB"}}
        every = {"every": "100ms", "heartbeat": "100ms"}
        file = write_config(folder / "c.yaml", endpoint, lines, defaults=every, **how)
        ends.enter_context(started(file)).says("history ready")
        lateness = Lateness(ends.enter_context(opened(endpoint)))
        time.sleep(seconds)
        print(f"before the back-fill: {lateness.shown()}", flush=True)
        begun = time.perf_counter()
        store, options = folder / "archive", ("--connect", endpoint, "--rate", rate)
        program = ends.enter_context(gateway("archive", "run", store, *options))
        program.says("archived after the beginning")
        cursors = ParquetStore(str(store)).cursors
        while not (found := list(cursors().values())) or found[0].samples < samples:
            time.sleep(0.2)
        took = time.perf_counter() - begun
        print(f"back-fill: {samples} samples, {samples / took:,.0f} a second", flush=True)
        print(f"during the back-fill: {lateness.shown()}", flush=True)


STORES = {"parquet": parquet_store, "postgres": postgres_store}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--gateways", type=int, default=100)
    parser.add_argument("--history", type=int, default=1_000_000, help="samples to back-fill")
    parser.add_argument("--rate", type=int, default=1_000_000, help="of the back-fill")
    parser.add_argument("--seconds", type=float, default=20.0, help="of live values before it")
    parser.add_argument("--store", nargs="*", default=list(STORES))
    given = parser.parse_args(arguments)
    if given.history:
        back_fill(given.history, given.rate, given.seconds)
    for name in given.store:
        with STORES[name]() as (store, ask):
            store.cursors()
            rate = fill(store, given.gateways, given.samples)
            print(f"{name}: {given.samples} samples of {given.gateways} gateways", flush=True)
            print(f"  stored: {rate:,.0f} samples a second", flush=True)
            ask()


if __name__ == "__main__":
    main()
