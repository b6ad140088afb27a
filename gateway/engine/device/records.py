"""Counts of lines, devices and polls since the start."""

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.errors import DeviceError, Garbled, NoReply, Refused

COMPLETE, MODEM_LOST = "complete", "modem lost"  # results of calls, beside the modem's words
DAY = 86_400.0  # seconds
MOST_FALLS = 1000  # times that are kept: one each 86 s of a day
LATELY = 32  # requests whose ends are kept
QUICKEST_OF = 50  # exchanges
FASTER = 0.03  # by which the clock of a station may be fast
# A reply is late from so many seconds on, at least, and from so many times the usual turnaround
_LATE, _SLOWER = 0.02, 3.0
SOONER = 0.002  # seconds, at least, by which a reply comes sooner than the station can reply
MOST_RESULTS = 20  # a modem that says noise does not fill the memory


class CallState(StrEnum):
    """The telephone of a line, for users."""

    IDLE = "idle"
    DIALLING = "dialling"
    CONNECTED = "connected"


@dataclass(slots=True)
class CallRecord:
    """Telephone calls of a line since the start. Times by the line's clock."""

    state: CallState = CallState.IDLE
    since: float | None = None  # when the state began
    made: int = 0  # calls with a carrier
    failed: int = 0  # tries without a carrier, and calls that broke off
    last_failure: str = ""
    last_result: str = ""
    results: Counter[str] = field(default_factory=Counter)

    def enter(self, state: CallState, now: float) -> None:
        self.state, self.since = state, now

    def connect(self, now: float) -> None:
        """Begins a call: the carrier is there."""
        self.enter(CallState.CONNECTED, now)
        self.made += 1

    def fail(self, why: str, result: str) -> None:
        """Counts a call that failed."""
        self.failed += 1
        self.last_failure = why
        self.count(result)

    def lose(self, why: str, now: float) -> None:
        """Notes that the modem is lost, perhaps in a call."""
        if self.state is not CallState.IDLE:
            self.fail(why, MODEM_LOST)
            self.enter(CallState.IDLE, now)

    def count(self, result: str) -> None:
        """Counts the end of a call, or of a try."""
        self.last_result = result
        known = result in self.results or len(self.results) < MOST_RESULTS
        self.results[result if known else "other"] += 1


@dataclass(slots=True)
class Falls:
    """The times at which a line was lost, or a device fell silent."""

    since: float | None = None  # it is still down; by the line's clock
    ended: float = -math.inf  # when it was there again last
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_FALLS))

    def fall(self, now: float) -> None:
        """Notes that it is down. It may be known already."""
        if self.since is None:
            self.since = now
            self._times.append(now)

    def rise(self, now: float) -> None:
        """Notes that it is there again. It may be known already."""
        if self.since is not None:
            self.since, self.ended = None, now

    def last_day(self, now: float) -> int:
        """Returns how often it fell in the last 24 hours."""
        while self._times and now - self._times[0] > DAY:
            self._times.popleft()
        return len(self._times)

    def lasts(self, now: float) -> float | None:
        """Returns the seconds that it has been down; None: it is not."""
        return None if self.since is None else round(now - self.since, 1)


@dataclass(slots=True)
class Resyncs:
    """The resyncs that requests without a reply made necessary."""

    seconds: float = 0.0

    def used(self, now: float, begun: float) -> None:
        self.seconds += now - begun


@dataclass(slots=True)
class LineRecord:
    """Counts of a line since the start. Times in seconds."""

    opened: int = 0
    since: float = 0.0  # when it was opened last, by the line's clock
    open_before: float = 0.0  # seconds that it was open before that
    busy: float = 0.0  # characters on the wire, both ways
    turnarounds: float = 0.0  # of stations that replied
    requested: float = 0.0  # in transactions of writes, commands and peeks
    resyncs: Resyncs = field(default_factory=Resyncs)
    unasked: int = 0  # bytes that arrived outside of a transaction
    trouble: str = ""  # why the port is not open
    last_trouble: str = ""  # why the port was not open last
    falls: Falls = field(default_factory=Falls)
    calls: CallRecord | None = None  # with a modem, once it was there
    # When a write or command ended last, by the line's clock: what was read before may be old.
    wrote_at: float = -math.inf

    def open(self, now: float) -> None:
        """Notes that the port was opened."""
        self.opened += 1
        self.falls.rise(now)
        self.since, self.trouble = now, ""

    def lose(self, why: str, now: float, *, was_open: bool) -> None:
        """Notes that the port was lost, or could not be opened."""
        if was_open:
            self.open_before += now - self.since
        self.falls.fall(now)
        self.trouble = self.last_trouble = why

    def count(self, seconds: float, turnaround: float) -> None:
        """Counts a transaction: the seconds of its characters, and those of the stations."""
        self.busy += seconds
        self.turnarounds += turnaround

    def used(self, now: float, begun: float) -> None:
        """Counts the transaction of a request, with its resyncs and time-outs."""
        self.requested += now - begun

    def count_unasked(self, size: int) -> None:
        self.unasked += size

    def telephone(self) -> CallRecord:
        """Returns the record of its calls, which outlives the modem."""
        if self.calls is None:
            self.calls = CallRecord()
        return self.calls


@dataclass(slots=True)
class Recent:
    """The ends of the last requests of a device, its last good read, and its port."""

    ends: deque[str] = field(default_factory=lambda: deque(maxlen=LATELY))  # evidence, or ""
    errors: dict[str, DeviceError] = field(default_factory=dict)  # the last one by evidence
    good: float | None = None  # the last good read that a poll forgot, by the line's clock
    port_note: str = ""  # why it may not answer: the port has other settings than the file

    def opened(self, note: str) -> None:
        """Notes what is wrong with the port that was opened; empty: nothing."""
        self.port_note = note

    def fail(self, kind: str, error: DeviceError) -> None:
        self.ends.append(kind)
        self.errors[kind] = error

    def failed(self) -> Counter[str]:
        """Returns the failures of the last requests by evidence."""
        return Counter(kind for kind in self.ends if kind)

    def usual(self) -> DeviceError | None:
        """Returns the most frequent failure of the last requests, not an odd one."""
        most = self.failed().most_common(1)
        return self.errors[most[0][0]] if most else None

    def was_good(self, at: float | None) -> None:
        """Notes the last good read of a poll that forgets it."""
        if at is not None:
            self.good = at if self.good is None else max(at, self.good)


@dataclass(slots=True)
class Replies:
    """The turnarounds of one station. Seconds."""

    turnaround: float | None = None  # smoothed over about ten exchanges
    typical: float | None = None  # the same, but each counts as late at most
    quickest: float = math.inf  # of many recent exchanges
    soonest: float = -math.inf  # a reply that comes sooner may be another one
    # Replies come before their characters can be over, by this share of their time; <= 0
    _ahead: float = 0.0
    _quickest_now: float = math.inf  # of those that are counted at present
    _ahead_now: float = 0.0
    _early: int = 0
    _counted: int = 0

    def count(self, own: float, ahead: float = 0.0) -> None:
        """Counts a turnaround. `ahead`: it came before its characters could be over; <= 0."""
        known = self.turnaround
        self.turnaround = own if known is None else known + 0.1 * (own - known)
        typical = own if self.typical is None else self.typical
        self.typical = typical + 0.1 * (min(own, late_from(typical)) - typical)
        if ahead < -FASTER:
            self._early += 1
            self._ahead_now = min(self._ahead_now, ahead)
            if self._ahead:
                self._ahead = min(self._ahead, ahead)
        elif own < self._quickest_now:
            self._quickest_now = own
            self.soonest = min(self.soonest, _soonest(own))
        self._counted += 1
        if self._counted >= QUICKEST_OF:
            self._begin_again()

    def _begin_again(self) -> None:
        # A few that came early are others. If most do, the wire is faster than the file says.
        self._ahead = self._ahead_now if 2 * self._early > self._counted else 0.0
        self.quickest = 0.0 if self._ahead else self._quickest_now
        self.soonest = _soonest(self.quickest)
        self._quickest_now, self._ahead_now, self._early, self._counted = math.inf, 0.0, 0, 0

    def is_too_soon(self, own: float, busy: float) -> bool:
        """Returns True if the station cannot have replied with this turnaround: it may be below 0.

        `busy`: seconds of the characters.
        """
        if self.soonest > 0.0:
            return own < self.soonest
        return own < min(self.soonest, (self._ahead - FASTER) * busy)


def late_from(usual: float) -> float:
    """Returns the turnaround above which a reply is late."""
    return max(_LATE, _SLOWER * usual)


def _soonest(quickest: float) -> float:
    """Returns the turnaround below which a reply comes too soon."""
    return max(quickest - max(quickest / 2, SOONER), 0.0)


@dataclass(slots=True)
class Record:
    """Counts of a device since the start. Times in seconds."""

    exchanges: int = 0
    writes: int = 0
    wire_time: float = 0.0
    late: int = 0  # replies after the time-out
    unasked: int = 0  # stray frames
    heard: int = 0  # correct unsolicited frames
    overruns: int = 0  # polls that were skipped because the one before was late
    overdue: int = 0  # blocks whose values became too old
    retries: int = 0  # failed reads that were repeated
    falls: Falls = field(default_factory=Falls)  # into silence
    recent: Recent = field(default_factory=Recent)
    failures: Counter[str] = field(default_factory=Counter)  # by evidence
    refusals: Counter[str] = field(default_factory=Counter)  # by the code of the device
    replies: Replies = field(default_factory=Replies)
    slowest_write: float = 0.0

    def count_exchanges(
        self,
        exchanges: int,
        characters: float,
        turnarounds: float,
        ahead: float = 0.0,
        *,
        own: bool = True,
    ) -> None:
        """Counts requests with a reply, and the seconds of their characters and turnarounds.

        `ahead`: as in `Replies.count`. `own` False: a reply may be another one, and says nothing of
        the station.
        """
        self.wire_time += characters + turnarounds
        if exchanges:
            self.recent.ends.append("")
            self.exchanges += exchanges
            if own:
                self.replies.count(turnarounds / exchanges, ahead)

    def count_write(self, took: float) -> None:
        self.writes += 1
        self.slowest_write = max(self.slowest_write, took)

    def count_failure(self, error: DeviceError) -> None:
        kind = str(error.evidence) if isinstance(error, NoReply | Garbled) else "other"
        self.failures[kind] += 1
        self.recent.fail(kind, error)

    def count_refusal(self, error: Refused) -> None:
        self.refusals[error.code] += 1

    def count_retry(self) -> None:
        self.retries += 1

    def count_late(self) -> None:
        self.late += 1

    def count_stray(self, frames: int = 1) -> None:
        self.unasked += frames

    def count_unsolicited(self) -> None:
        self.heard += 1

    def count_overruns(self, missed: int) -> None:
        self.overruns += missed

    def count_overdue(self) -> None:
        self.overdue += 1
