"""The tables of the history file, made in a new file and added to an older one."""

import sqlite3
from pathlib import Path

from gateway.parts.history import sections

APPLICATION = 0x706C6368  # "plch", in the file's header
SCHEMA_VERSION = 1

_SCHEMA = """
CREATE TABLE tag (id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE);
CREATE TABLE recent (
    run INTEGER, n INTEGER, tag INTEGER, time INTEGER, value, kind INTEGER, bad TEXT,
    PRIMARY KEY (run, n)
) WITHOUT ROWID;
CREATE TABLE sample (
    run INTEGER, tag INTEGER, time INTEGER, n INTEGER, value, kind INTEGER, bad TEXT,
    PRIMARY KEY (run, tag, time, n)
) WITHOUT ROWID;
CREATE TABLE run (
    run INTEGER PRIMARY KEY, first INTEGER, last INTEGER, samples INTEGER, closed INTEGER
);
CREATE TABLE written (id INTEGER PRIMARY KEY, time INTEGER, outcome TEXT);
CREATE INDEX written_time ON written (time);
CREATE VIEW history AS
    SELECT key, datetime(time / 1000000000, 'unixepoch') AS utc, time, value, bad
    FROM sample JOIN tag ON tag.id = sample.tag
    UNION ALL
    SELECT key, datetime(time / 1000000000, 'unixepoch'), time, value, bad
    FROM recent JOIN tag ON tag.id = recent.tag;
"""

# Older files lack them.
_LATER = ("refused", "alarms")
_OUTCOMES = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS {0} (id INTEGER PRIMARY KEY, time INTEGER, outcome TEXT);
CREATE INDEX IF NOT EXISTS {0}_time ON {0} (time);
COMMIT;
"""

_MARK = """
CREATE TABLE file (mark BLOB);
INSERT INTO file VALUES (randomblob(16));
"""


class ForeignFile(Exception):
    """A database, but no history that this version can use."""


def prepare(database: sqlite3.Connection, path: Path) -> None:
    [(application,)] = database.execute("PRAGMA application_id")
    [(version,)] = database.execute("PRAGMA user_version")
    [(tables,)] = database.execute("SELECT count(*) FROM sqlite_schema")
    if tables and application != APPLICATION:
        raise ForeignFile(f"{path} is a database of another program")
    if tables and version != SCHEMA_VERSION:
        raise ForeignFile(f"{path} has format {version}, and this gateway writes {SCHEMA_VERSION}")
    database.execute("PRAGMA page_size = 4096")
    database.execute("PRAGMA auto_vacuum = INCREMENTAL")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA cache_size = -4000")
    if not tables:
        database.executescript(
            f"BEGIN IMMEDIATE; PRAGMA application_id = {APPLICATION};"
            f" PRAGMA user_version = {SCHEMA_VERSION}; {_SCHEMA} {_MARK} COMMIT;"
        )
    elif not database.execute("SELECT 1 FROM sqlite_schema WHERE name = 'file'").fetchall():
        database.executescript(f"BEGIN IMMEDIATE; {_MARK} COMMIT;")  # older files had none
    database.execute(sections.TABLE)
    sections.adopt_tags(database)
    for table in _LATER:
        there = database.execute("SELECT 1 FROM sqlite_schema WHERE name = ?", (table,))
        if not there.fetchall():
            database.executescript(_OUTCOMES.format(table))
