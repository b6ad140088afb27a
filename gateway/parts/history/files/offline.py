"""A history file that is only read: of a running gateway, of a stopped one, or a copy."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from gateway.errors import GatewayError
from gateway.parts.history.answers.course import Course
from gateway.parts.history.answers.recent import Extent, Recent
from gateway.parts.history.answers.search import Search
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.file import identity, next_number, runs_of
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.schema import APPLICATION, SCHEMA_VERSION

_MOST_BUCKETS = 10_000_000  # of one tag: nobody waits for this reader


@contextmanager
def offline(path: Path) -> Iterator[tuple[Search, Course]]:
    """Opens the history as it is now. Raises `GatewayError`."""
    if not path.is_file():
        raise GatewayError(f"there is no history {path}")
    reader = Reader(path)
    try:
        recent = _content(path)
        damage = Damage(most_logged=0)  # the answers tell it
        search = Search(recent, reader, damage)
        yield search, Course(recent, reader, damage, _MOST_BUCKETS)
    except (sqlite3.Error, OSError) as error:
        raise GatewayError(f"{path} cannot be read: {error}") from None
    finally:
        reader.renew()


def _content(path: Path) -> Recent:
    """Returns the list of the runs. Samples without a run are runs that are not closed."""
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as database:
        database.execute("BEGIN")  # one state of the file for all statements
        [(application,)] = database.execute("PRAGMA application_id")
        [(version,)] = database.execute("PRAGMA user_version")
        if (application, version) != (APPLICATION, SCHEMA_VERSION):
            raise GatewayError(f"{path} is no history of this version")
        recent = Recent(longest=2**62, oldest=float("inf"))
        recent.opened(identity(database, path), (), lambda *_: Extent(0, 0, 0), 0)
        recent.set_sorted(runs_of(database, next_number(database)))
        return recent
