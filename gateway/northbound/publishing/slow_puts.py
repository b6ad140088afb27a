"""Values that a full link may have dropped, and the times when they are put again.

Zenoh does not report a dropped put. A put to a full link takes as long as the drop limit, then it
is dropped; until the link has sent something, it drops the next ones at once. So every value that
is put after a slow put is suspect. Nothing tells when the link has room again: suspects are put
again in rounds with growing pauses, and the next slow put starts the rounds again.
"""

import threading
from collections.abc import Iterable

# Seconds from the last slow put to each round. A link that sends nothing for longer is closed as
# a rule; then all values are published again when it returns.
ROUNDS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
_NEVER = float("-inf")


class SlowPuts:
    """Filled by the publishing thread, emptied on the event loop."""

    def __init__(self, limit: float) -> None:
        """`limit`: seconds that a put waits for room before Zenoh drops it."""
        self.congested = 0  # puts that took as long as `limit`, since the start
        self.limit = limit
        self.until = _NEVER  # what is put before is suspect
        self._slow_at = _NEVER
        self._round = 0
        self._suspects: dict[str, None] = {}  # keys of values, in the order of their last put
        self._lock = threading.Lock()

    def sent(self, keys: Iterable[str], took: float, now: float) -> None:
        """Notes one put: the keys of its values, and how many seconds it took."""
        if took < self.limit and now > self.until:
            return
        with self._lock:
            if took >= self.limit:
                self.congested += 1
                self._slow_at, self.until = now, now + ROUNDS[-1]
                self._round = 0
            for key in keys:
                self._suspects.pop(key, None)
                self._suspects[key] = None

    def due(self, now: float) -> list[str]:
        """Returns the keys to put again now; the longest waiting first."""
        with self._lock:
            if not self._suspects or now < self._slow_at + ROUNDS[self._round]:
                return []
            keys = list(self._suspects)
            self._round += 1
            if self._round == len(ROUNDS):
                self._suspects.clear()
                self._round = 0
            return keys
