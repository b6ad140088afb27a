"""The tables of the history file."""

import sqlite3
from contextlib import closing
from pathlib import Path

from gateway.parts.history.answers.outcomes import Ring

APPLICATION = 0x706C6368  # "plch", in the file's header
SCHEMA_VERSION = 2

# Samples in the order of recording: `id` counts them. A run of them gets a row in `run` when it is
# closed. The table `file` identifies the file, counts the names in `tag`, and has the number of the
# oldest sample that was not dropped.
_SCHEMA = """
CREATE TABLE tag (id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, sum INTEGER);
CREATE TABLE sample (
    id INTEGER PRIMARY KEY, tag INTEGER, time INTEGER, value, kind INTEGER, bad TEXT, sum INTEGER
);
CREATE TABLE run (
    id INTEGER PRIMARY KEY, first INTEGER, last INTEGER, samples INTEGER, closed INTEGER,
    sum INTEGER, places BLOB
);
CREATE VIEW history AS
    SELECT key, datetime(time / 1000000000, 'unixepoch') AS utc, time, value, bad
    FROM sample JOIN tag ON tag.id = sample.tag;
CREATE TABLE file (mark BLOB, tags INTEGER, oldest INTEGER);
INSERT INTO file VALUES (randomblob(16), 0, 1);
"""
_OUTCOMES = """
CREATE TABLE {0} (id INTEGER PRIMARY KEY, time INTEGER, outcome TEXT);
CREATE INDEX {0}_time ON {0} (time);
"""
_SCRIPT = (
    f"BEGIN IMMEDIATE; PRAGMA application_id = {APPLICATION};"
    f" PRAGMA user_version = {SCHEMA_VERSION}; {_SCHEMA} {''.join(map(_OUTCOMES.format, Ring))}"
    " COMMIT;"
)


class ForeignFile(Exception):
    """A database, but no history that this version can use."""


def prepare(database: sqlite3.Connection, path: Path) -> None:
    [(application,)] = database.execute("PRAGMA application_id")
    [(version,)] = database.execute("PRAGMA user_version")
    found = _tables(database)
    if found and application != APPLICATION:
        raise ForeignFile(f"{path} is a database of another program")
    if found and version != SCHEMA_VERSION:
        raise ForeignFile(f"{path} has format {version}, and this gateway writes {SCHEMA_VERSION}")
    database.execute("PRAGMA page_size = 4096")
    database.execute("PRAGMA auto_vacuum = INCREMENTAL")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA cache_size = -4000")
    if not found:
        database.executescript(_SCRIPT)
        return
    with closing(sqlite3.connect(":memory:")) as new:
        new.executescript(_SCRIPT)
        if other := found ^ _tables(new):
            raise ForeignFile(f"{path} has another {' '.join(min(other)[:2])} than this gateway's")


def _tables(database: sqlite3.Connection) -> set[tuple[str, str, str]]:
    """Returns tables, indexes and triggers, each with its SQL. A view changes nothing."""
    return {
        (str(kind), str(name), str(sql))
        for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_schema")
        if kind != "view"
    }
