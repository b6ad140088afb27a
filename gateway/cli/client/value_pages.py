"""Queries the values of many tags in pages, so that each arrives in time over a slow link too."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import orjson
import zenoh

from gateway.errors import GatewayError

REPLY_TIMEOUT = 10.0  # seconds, for one query
FIRST = 100  # values in the first page: 2 s at 64 kbit/s
PAGE_WITHIN = 2.0  # seconds that the next page should take
CHANGED = "does the gateway run with the current version of this file?"
_CUT = "not all values have arrived: is the link interrupted, or slower than 64 kbit/s?"
Query = Callable[[str], list[zenoh.Reply]]  # raises `GatewayError` for an error reply


def paged(query: Query, key: str) -> Iterator[zenoh.Sample]:
    """Yields the values that a wildcard matches. Raises `GatewayError` where some lack.

    Several gateways may reply, each in pages of its own.
    """
    from gateway.northbound.answering.pages import LARGEST  # with all about tags

    size, places = FIRST, dict[str, str]()
    unfinished: set[str] = set()
    while True:
        began = time.monotonic()
        after = f";after={','.join(places.values())}" if places else ""
        samples, ends = _split(query(f"{key}?page={size}{after}"))
        gateways = {gateway for gateway, _, _, _ in ends}
        lacking = len(samples) < sum(count for _, count, _, _ in ends)
        if lacking or not unfinished <= gateways or (samples and not gateways):
            raise GatewayError(_CUT)
        yield from samples
        places |= {gateway: place for gateway, _, place, _ in ends}
        unfinished = {gateway for gateway, _, _, complete in ends if not complete}
        if not unfinished:
            return
        took = max(time.monotonic() - began, 0.001)
        size = min(max(int(size * PAGE_WITHIN / took), 1), LARGEST)


def _split(
    replies: list[zenoh.Reply],
) -> tuple[list[zenoh.Sample], list[tuple[str, int, str, bool]]]:
    """Returns the values, and the end of each gateway's page: its key, count, place, complete."""
    samples, ends = list[zenoh.Sample](), list[tuple[str, int, str, bool]]()
    for reply in replies:
        if reply.ok is None:
            continue
        key = str(reply.ok.key_expr)
        if not (key.endswith("/page") and "/@gateway/" in key):
            samples.append(reply.ok)
            continue
        with suppress(orjson.JSONDecodeError):
            match orjson.loads(reply.ok.payload.to_bytes()):
                case {"samples": int(count), "next": str(place), "complete": bool(complete)}:
                    ends.append((key, count, place, complete))
    return samples, ends
