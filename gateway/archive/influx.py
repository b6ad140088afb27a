"""InfluxDB: the points of `bridge influx`, and the cursor as a point of `plc_archive`.

A point of the same tag and time replaces the one before. So a page that is written again after a
crash changes nothing, and the cursor may follow in a second request.
"""

import http.client
import time
import urllib.error
from collections.abc import Mapping, Sequence
from urllib.parse import parse_qs, urlencode, urlsplit

import orjson

from gateway.archive.rows import Row
from gateway.archive.store import Cursor, Gap, StoreDown, cursor_of
from gateway.bridges.influx.lines import escaped, line_of, quoted
from gateway.bridges.influx.server import request
from gateway.errors import ConfigError, words_of

_BATCH = 5000  # lines of a request
_ANSWER_WITHIN = 60.0  # seconds
_REFUSED = (400, 413, 422)  # for ever; other errors are those of the server or of its settings
_CURSORS = "SELECT last(document) FROM plc_archive GROUP BY gateway"


class InfluxStore:
    """See `Store`. The token is in `INFLUX_TOKEN`."""

    every = 10.0

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        about = parse_qs(parts.query)
        database = (about.get("db") or about.get("bucket") or [""])[0]
        if not database or not parts.hostname:
            raise ConfigError(
                f"{address} names no database: http://host:8086/write?db=name, or InfluxDB 3: "
                "http://host:8181/api/v3/write_lp?db=name"
            )
        self._write = address
        query = urlencode({"db": database, "q": _CURSORS, "epoch": "ns"})
        self._query = f"{parts.scheme}://{parts.netloc}/query?{query}"
        self._last = 0  # ns since 1970, of the newest cursor: the next one must be newer

    def cursors(self) -> Mapping[str, Cursor]:
        """A server without `/query` has none: its points are written again from the beginning."""
        try:
            result = orjson.loads(self._request(self._query))["results"][0]
            rows = [one["values"][0] for one in result.get("series", ())]
            self._last = max([self._last, *(at for at, _ in rows)])
        except (ValueError, TypeError, LookupError):
            raise StoreDown("the answer to a query of cursors is none of InfluxDB") from None
        except urllib.error.HTTPError as error:
            if error.code == http.HTTPStatus.NOT_FOUND:
                return {}
            raise StoreDown(f"cursors: {error}, {error.read(200)!r}") from None
        cursors = [cursor_of(text) for _, text in rows]
        return {cursor.gateway: cursor for cursor in cursors}

    def add(self, rows: Sequence[Row], before: Cursor, after: Cursor) -> Cursor:
        prefix = before.gateway.partition("@gateway/")[0]
        for at in range(0, len(rows), _BATCH):
            batch = rows[at : at + _BATCH]
            lines = [line_of(row.key.removeprefix(prefix), row.document()) for row in batch]
            try:
                self._request(self._write, "\n".join(lines).encode())
            except urllib.error.HTTPError as error:
                times = [row.document()["time"] for row in batch]
                if error.code not in _REFUSED:
                    raise StoreDown(f"{error}") from None
                why = f"the server refused samples: {error}, {error.read(200).decode()}"
                after = after.with_gap(Gap(min(times), max(times), why))
        after = after.with_rows(rows, len(rows))
        fields = f"document={quoted(after.to_json())}"
        self._last = max(self._last + 1, time.time_ns())  # a clock may be set back
        line = f"plc_archive,gateway={escaped(after.gateway)} {fields} {self._last}"
        try:
            self._request(self._write, line.encode())
        except urllib.error.HTTPError as error:
            raise StoreDown(f"cursor: {error}, {error.read(200)!r}") from None
        return after

    def close(self) -> None:
        pass

    def _request(self, url: str, body: bytes | None = None) -> bytes:
        """Raises `StoreDown`, and `HTTPError` for an answer."""
        try:
            return request(url, body, _ANSWER_WITHIN)
        except urllib.error.HTTPError:
            raise
        except (OSError, http.client.HTTPException) as error:
            raise StoreDown(words_of(error)) from None
