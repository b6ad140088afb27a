"""The pace of the probes of a device without replies: when they are due, and how patient."""

import math
from dataclasses import dataclass

PAUSE_FIRST, PAUSE_LONGEST = 1.0, 60.0  # seconds between two tries of a block without replies
PAUSE_ALIVE, ALIVE_FOR = 0.05, 10.0  # seconds: the pause, and since bytes arrived
HOPE_FOR = 30.0  # seconds without a good reply after which damaged ones are no sign of noise
PAUSE_LATE = 60.0  # the longest time between two probes of one that is later than `reply_timeout`
LATE_FOR = 60.0  # seconds for which a late reply shows that waiting for it is of use
LATE_MOST = 1.0  # seconds by which a reply is known to be late, at most: another master may ask
PROBE_PAUSE = 4.0  # the longest time between two probes of an offline device; the first is 1 s
PROBE_SPREAD = 0.1  # share by which it varies
ABSENT_PAUSE = 10.0  # times the time that a gateway on the way waited for it in vain
MOST_BEHIND = 30.0  # seconds for which no probe is sent, because older ones wait at a server


@dataclass(slots=True, eq=False)
class ProbePace:
    """The pace of the probes of one device. Times in seconds of the line's clock."""

    pause: float = 0.0  # until the next probe of an offline device
    due: float = 0.0
    short: int = 0  # short probes since the last patient one, or the last reply
    patient: bool = False  # the next probe waits for the whole `reply_timeout`: it replies late
    token: int = 0  # of the last resync
    _behind_until: float = -math.inf  # until then a server has older requests to pass on
    _last: float = -math.inf  # of an offline device
    _last_bytes: float = -math.inf  # damaged replies are a sign of life
    _damaged_since: float = math.inf  # without a good one since
    _last_late: float = -math.inf  # a late reply, or one to an older request
    _late_by: float = 0.0  # seconds that a reply came behind the last request, at least
    _late_seen: float = -math.inf  # when it did
    _waited: bool = False  # the last probe was a patient one,
    _late_since: float = math.inf  # and since then each reply has come behind such a probe

    def restart(self) -> None:
        self.short = 0

    def begin_tokens(self) -> None:
        self.token = 0

    def next_token(self) -> int:
        self.token += 2
        return self.token

    def replied(self) -> None:
        self.short, self.pause = 0, 0.0
        self._damaged_since = self._late_since = math.inf

    def replied_damaged(self, now: float) -> None:
        self._last_bytes, self._damaged_since = now, min(self._damaged_since, now)

    def replied_late(self, now: float) -> None:
        self._last_late = now

    def grow(self, now: float, spread: float) -> None:
        """Doubles the pause before the next probe. It is short while damaged replies arrive: then
        the wire is the trouble."""
        self.pause = min(max(2 * self.pause, PAUSE_FIRST), PROBE_PAUSE)
        if self.is_urgent(now):
            self.pause = PAUSE_ALIVE
        self.due = max(now + self.pause * spread, self._behind_until)
        self._last = now

    def may_be_sent(self, now: float) -> bool:
        """Returns True if the last probe is old enough for one on behalf of a client."""
        return max(self._last + PAUSE_FIRST, self._behind_until) <= now

    def is_alive(self, now: float) -> bool:
        """Returns True if damaged replies of the device arrived a short time ago."""
        return now - self._last_bytes < ALIVE_FOR

    def is_urgent(self, now: float) -> bool:
        """Returns True if it is alive, and the next reply may be good: a station of which all
        replies are damaged is no victim of noise, and takes no more of the wire than a dead one."""
        return self.is_alive(now) and now - self._damaged_since < HOPE_FOR

    @property
    def is_back(self) -> bool:
        """True if it replied behind a short probe: the patient one that is next will be answered,
        unless it is later than `reply_timeout`."""
        return self.patient and not self._waited

    def was_late(self, now: float) -> bool:
        """Returns True if a reply of the device came late in the last minute."""
        return now - self._last_late < LATE_FOR

    def replied_behind(self, now: float, took: float) -> None:
        """Notes a reply to an older request, `took` seconds after the last one ended."""
        if now - self._late_seen >= LATE_FOR:
            self._late_by = 0.0
        self._late_by, self._late_seen = max(self._late_by, min(took, LATE_MOST)), now

    def lateness(self, now: float) -> float:
        """Returns the seconds in which a request may still be answered: twice as long as the latest
        reply of the last minute was late; 0: none was."""
        return 2 * self._late_by if now - self._late_seen < LATE_FOR else 0.0

    def spoke(self, now: float, longest_reply: float, *, alone: bool = False) -> None:
        """Notes a sound frame while it was offline: it replies later than the last probe waited.

        Behind a patient probe it is later than `reply_timeout`. Each probe costs others that time,
        and its reply meets their exchanges. `alone`: there are none.
        """
        if self.patient:
            return
        self.patient = True
        if self._waited and not alone:
            self._late_since = min(self._late_since, now)
            self.due = max(self.due, now + min(now - self._late_since, PAUSE_LATE))
            return
        if now - self._last <= longest_reply:
            self.due = now
        self.soon()

    def soon(self) -> None:
        """Shortens the pause, because a client waits."""
        self.due = max(min(self.due, self._last + PAUSE_FIRST), self._behind_until)

    def behind(self, now: float, age: float, *, more: bool) -> None:
        """Notes a reply to a request of this age, from a server that passes on one at a time. Its
        queue would grow with each probe. `more`: younger requests wait there."""
        self._behind_until = self.due = now + min(2 * age, MOST_BEHIND) if more else now

    def absent(self, now: float, age: float) -> None:
        """Notes that a gateway waited in vain for the reply to a request of this age. Meanwhile the
        stations beside this one had no replies either."""
        self._behind_until = now + min(ABSENT_PAUSE * age, MOST_BEHIND)
        self.due = max(self.due, self._behind_until)

    def sent(self, *, short: bool) -> None:
        """Counts a probe that is sent."""
        self.short = self.short + 1 if short else 0
        self._waited = not short
        if not short:
            self.patient = False
