"""PostgreSQL: table `plc_sample`, a hypertable where the database has TimescaleDB.

Rows arrive by COPY, in one transaction with the cursor of the gateway.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import psycopg
from psycopg.pq import TransactionStatus

from gateway.archive.rows import Row, rfc3339
from gateway.archive.store import Cursor, Overtaken, StoreDown, cursor_of
from gateway.errors import ConfigError

_LOCK = 0x706C6361  # of this program: two archivers must not create the tables at once
# A database that stopped answering must not keep the archiver for ever.
_BOUNDS = "-c lock_timeout=10s -c statement_timeout=120s -c timezone=UTC"
_SCHEMA = """
CREATE TABLE IF NOT EXISTS plc_tag (
    id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY, key text NOT NULL UNIQUE);
CREATE TABLE IF NOT EXISTS plc_sample (
    time timestamptz NOT NULL, tag integer NOT NULL, value double precision, text text,
    elements double precision[], reason text, origin text, limited text);
CREATE INDEX IF NOT EXISTS plc_sample_tag_time ON plc_sample (tag, time DESC);
CREATE TABLE IF NOT EXISTS plc_cursor (gateway text PRIMARY KEY, document jsonb NOT NULL);
CREATE OR REPLACE VIEW plc_history AS
    SELECT time, key, value, text, elements, reason, origin, limited,
        CASE WHEN reason IS NULL THEN 'good'
            WHEN value IS NULL AND text IS NULL AND elements IS NULL THEN 'bad'
            ELSE 'uncertain' END AS quality
    FROM plc_sample JOIN plc_tag ON plc_tag.id = tag;
"""
_HYPERTABLE = "SELECT create_hypertable('plc_sample', 'time', if_not_exists => true)"
_BY_TIME = "CREATE INDEX IF NOT EXISTS plc_sample_time ON plc_sample USING brin (time)"
_COLUMNS = "time, tag, value, text, elements, reason, origin, limited"
_CONTENT = "{0}.value, {0}.text, {0}.elements, {0}.reason, {0}.origin, {0}.limited"
_NEW = f"""
INSERT INTO plc_sample ({_COLUMNS}) SELECT DISTINCT {_COLUMNS} FROM plc_page p
WHERE NOT EXISTS (SELECT FROM plc_sample s WHERE s.tag = p.tag AND s.time = p.time
    AND ({_CONTENT.format("s")}) IS NOT DISTINCT FROM ({_CONTENT.format("p")}))
"""  # noqa: S608  (our own names)
_ESCAPES = str.maketrans({"\\": "\\\\", "\t": "\\t", "\n": "\\n", "\r": "\\r"})


class PostgresStore:
    """See `Store`. Passwords: in `PGPASSWORD` or `~/.pgpass`, as for `psql`."""

    every = 10.0

    def __init__(self, address: str) -> None:
        try:
            parts = psycopg.conninfo.conninfo_to_dict(address)
        except psycopg.ProgrammingError as error:
            raise ConfigError(f"{urlsplit(address).hostname}: {error}".strip()) from None
        if not parts.get("dbname"):
            raise ConfigError("the address names no database: postgresql://user@host/database")
        self.address = address
        self._connection: psycopg.Connection | None = None
        self._tags: dict[str, int] = {}

    def cursors(self) -> Mapping[str, Cursor]:
        with self._transaction() as connection:
            found = connection.execute("SELECT document::text FROM plc_cursor").fetchall()
        cursors = [cursor_of(text) for (text,) in found]
        return {cursor.gateway: cursor for cursor in cursors}

    def add(self, rows: Sequence[Row], before: Cursor, after: Cursor) -> Cursor:
        with self._transaction() as connection:
            connection.execute(
                "INSERT INTO plc_cursor VALUES (%s, %s) ON CONFLICT DO NOTHING",
                (before.gateway, before.to_json()),
            )
            [(text,)] = connection.execute(
                "SELECT document::text FROM plc_cursor WHERE gateway = %s FOR UPDATE",
                (before.gateway,),
            )
            if cursor_of(text).after != before.after:
                raise Overtaken(before.gateway)
            tags = _numbers(connection, {row.key for row in rows} - self._tags.keys())
            count = _copy(connection, rows, self._tags | tags, overlaps=after.overlaps)
            after = after.with_rows(rows, count)
            connection.execute(
                "UPDATE plc_cursor SET document = %s WHERE gateway = %s",
                (after.to_json(), after.gateway),
            )
        self._tags |= tags
        return after

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    @contextmanager
    def _transaction(self) -> Iterator[psycopg.Connection]:
        """Raises `StoreDown`. A commit without an answer may have been done: the cursor tells."""
        try:
            if self._connection is None:
                self._connection = self._opened()
            with self._connection.transaction():
                yield self._connection
        except psycopg.Error as error:
            self.close()
            raise StoreDown(str(error).strip().partition("\n")[0]) from None
        finally:
            connection = self._connection
            if connection and connection.info.transaction_status is not TransactionStatus.IDLE:
                self.close()

    def _opened(self) -> psycopg.Connection:
        self._tags.clear()  # another database may be there now
        connection = psycopg.connect(
            self.address,
            autocommit=True,
            connect_timeout=10,
            options=_BOUNDS,
            tcp_user_timeout=30_000,
            application_name="plc-gateway archive",
        )
        with ExitStack() as unless_ready:
            unless_ready.callback(connection.close)
            with connection.transaction():
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
                # A user who may only insert cannot create, not even what exists.
                [(known,)] = connection.execute("SELECT to_regclass('plc_cursor')")
                if known is None:
                    connection.execute(_SCHEMA)
                    timescale = "SELECT 1 FROM pg_extension WHERE extname = 'timescaledb'"
                    is_there = connection.execute(timescale).fetchone() is not None
                    connection.execute(_HYPERTABLE if is_there else _BY_TIME)
            unless_ready.pop_all()
        return connection


def _numbers(connection: psycopg.Connection, keys: Iterable[str]) -> dict[str, int]:
    """Returns the numbers of tags, new ones too."""
    if not (wanted := sorted(keys)):
        return {}
    new = "INSERT INTO plc_tag (key) SELECT unnest(%s::text[]) ON CONFLICT DO NOTHING"
    connection.execute(new, (wanted,))
    known = "SELECT key, id FROM plc_tag WHERE key = ANY(%s)"
    return dict(connection.execute(known, (wanted,)).fetchall())


def _copy(
    connection: psycopg.Connection, rows: Sequence[Row], tags: Mapping[str, int], *, overlaps: bool
) -> int:
    """Stores the rows; returns how many."""
    if not rows:
        return 0
    if overlaps:
        connection.execute("CREATE TEMP TABLE plc_page (LIKE plc_sample) ON COMMIT DROP")
    table = "plc_page" if overlaps else "plc_sample"
    with connection.cursor().copy(f"COPY {table} ({_COLUMNS}) FROM STDIN") as copy:
        copy.write("".join(_line(row, tags[row.key]) for row in rows))
    return connection.execute(_NEW).rowcount if overlaps else len(rows)


def _line(row: Row, tag: int) -> str:
    array = None if row.elements is None else f"{{{','.join(map(repr, row.elements))}}}"
    value = None if row.value is None else repr(row.value)
    columns = (value, row.text, array, row.reason, row.origin, row.limited)
    texts = ("\\N" if one is None else one.translate(_ESCAPES) for one in columns)
    return "\t".join((rfc3339(row.time), str(tag), *texts)) + "\n"
