"""Bounds what is open at once, in total and for each client, so that no client takes all of it."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from aiohttp import web


class Places:
    """A number of places, and how many of them one client may have."""

    def __init__(self, most: int, of_client: int, called: str) -> None:
        """`called`: what takes them, such as `requests`."""
        self._most = most
        self._of_client = of_client
        self._called = called
        self._taken: Counter[str] = Counter()

    @contextmanager
    def taken(self, client: str) -> Iterator[None]:
        """Takes a place. Raises `HTTPServiceUnavailable` if there is none."""
        if self._taken.total() >= self._most:
            raise web.HTTPServiceUnavailable(reason=f"{self._most} {self._called} are open already")
        if self._taken[client] >= self._of_client:
            reason = f"{self._of_client} {self._called} of this address are open already"
            raise web.HTTPServiceUnavailable(reason=reason)
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]
