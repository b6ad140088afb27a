"""A history file that is only read: of a running gateway, of a stopped one, or a copy."""

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

from gateway.errors import GatewayError
from gateway.parts.history import sections
from gateway.parts.history.course import Course
from gateway.parts.history.damage import Damage
from gateway.parts.history.file import identity
from gateway.parts.history.reader import Reader
from gateway.parts.history.recent import Recent
from gateway.parts.history.rows import from_row
from gateway.parts.history.schema import APPLICATION, SCHEMA_VERSION
from gateway.parts.history.search import Search
from gateway.tags import Publishing, Tag

_MOST_BUCKETS = 10_000_000  # of one tag: nobody waits for this reader


@contextmanager
def offline(path: Path, tags: Mapping[str, Tag]) -> Iterator[tuple[Search, Course]]:
    """Opens the history as it is now; `tags`: those that are read. Raises `GatewayError`."""
    if not path.is_file():
        raise GatewayError(f"there is no history {path}")
    reader = Reader(path)
    try:
        recent = _content(path, tags)
        damage = Damage(most_logged=0)  # the answers tell it
        search = Search(recent, reader, damage)
        yield search, Course(recent, reader, damage, _MOST_BUCKETS)
    except (sqlite3.Error, OSError) as error:
        raise GatewayError(f"{path} cannot be read: {error}") from None
    finally:
        reader.renew()


def _content(path: Path, tags: Mapping[str, Tag]) -> Recent:
    """Returns the list of sorted runs, and all samples that are not sorted yet."""
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as database:
        database.execute("BEGIN")  # one state of the file for all statements
        [(application,)] = database.execute("PRAGMA application_id")
        [(version,)] = database.execute("PRAGMA user_version")
        if (application, version) != (APPLICATION, SCHEMA_VERSION):
            raise GatewayError(f"{path} is no history of this version")
        recent = Recent(longest=2**62, oldest=float("inf"))
        recent.opened(identity(database, path), sections.runs(database), {})
        kept = {key: replace(tag, publishing=Publishing(history=True)) for key, tag in tags.items()}
        for key, time, value, kind, bad in database.execute(
            "SELECT key, time, value, kind, bad FROM recent JOIN tag ON tag.id = recent.tag"
            " ORDER BY run, n"
        ):
            if key in kept:
                recent.add([from_row(kept[key], time, value, kind, bad)])
            recent.latest = time
        return recent
