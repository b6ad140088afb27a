"""Keys that are declared to Zenoh, so that it need not look for their listeners at every put.

A put on a plain key is matched against everything declared beside it, and each device has a token
and a write key there: with 1,000 devices this takes 80 µs of the publishing thread. A declared key
remembers its way (2 µs), but declaring takes 0.1 ms and 2 kB: only what is published again and
again is worth it.
"""

import zenoh

MOST_DECLARED = 20_000
WORTH_IT = 3  # puts on one key


class Names:
    """The key to put on, declared once it has been used often. Belongs to one thread."""

    def __init__(self, session: zenoh.Session, most: int) -> None:
        """`most`: how many may be declared; 0 leaves all keys as they are."""
        self._session = session
        self._most = most
        self._used: dict[str, int] = {}
        self._declared: dict[str, zenoh.KeyExpr] = {}

    def __call__(self, key: str) -> str | zenoh.KeyExpr:
        """Raises `ZError`."""
        if known := self._declared.get(key):
            return known
        if len(self._declared) >= self._most:
            return key
        used = self._used.get(key, 0) + 1
        if used <= WORTH_IT:
            self._used[key] = used
            return key
        self._used.pop(key, None)
        declared: zenoh.KeyExpr = self._session.declare_keyexpr(key)
        self._declared[key] = declared
        return declared
