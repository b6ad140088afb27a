"""The alarms by state, those that a restart must not lose, and floods of alarms."""

from collections import Counter, deque
from collections.abc import Mapping

import structlog

from gateway.parts.alarms.entry import Entry
from gateway.parts.alarms.machine import Event, State
from gateway.tags.timestamps import rfc3339

log = structlog.get_logger("gateway")
LATELY = 600.0  # seconds
FLOOD, FLOOD_ENDS = 10, 5  # more, and fewer, alarms raised in this time: as in ISA-18.2
_MOST_COUNTED = 10_000  # alarms raised in this time


class Tally:
    """Belongs to the event loop; any thread may read it."""

    def __init__(self) -> None:
        self.open: dict[str, Entry] = {}  # those that are not normal
        self._kept: dict[str, Entry] = {}
        self._counts: Counter[State] = Counter()
        self._raised: deque[float] = deque(maxlen=_MOST_COUNTED)  # times by the loop's clock
        self._flood_since: int | None = None  # ns since 1970

    def add(self, entry: Entry) -> None:
        self._counts[entry.counted] += 1

    def count(self, entry: Entry) -> None:
        """Follows the state of an entry."""
        self._counts[entry.counted] -= 1
        entry.counted = entry.status.state
        self._counts[entry.counted] += 1
        is_open = entry.counted is not State.NORMAL
        for found, belongs in (
            (self.open, is_open),
            (self._kept, is_open or entry.alarm.is_kept),
        ):
            if belongs:
                found[entry.key] = entry
            else:
                found.pop(entry.key, None)

    def drop(self, entry: Entry) -> None:
        self.open.pop(entry.key, None)
        self._kept.pop(entry.key, None)
        self._counts[entry.counted] -= 1

    def kept(self) -> list[Entry]:
        return list(self._kept.values())

    def counts(self) -> Mapping[str, int]:
        """Returns alarms by state, and how many of the normal ones are suppressed."""
        ends = [one.status.suppressed for one in self.kept()]
        return {
            **{state.value: self._counts[state] for state in State},
            "shelved": sum(what is not None and what.until is not None for what in ends),
            "out_of_service": sum(what is not None and what.until is None for what in ends),
        }

    # -- floods --

    def note(self, entry: Entry, event: Event, now: float) -> None:
        """Counts what is raised. What is folded into another alarm since then counts no longer."""
        if event is Event.RAISED:
            entry.raised_at = now
            self._raised.append(now)
        elif event is Event.FOLDED and entry.raised_at in self._raised:
            self._raised.remove(entry.raised_at)

    def look(self, now: float, time: int) -> None:
        """Begins and ends a flood. `time`: ns since 1970."""
        while self._raised and now - self._raised[0] > LATELY:
            self._raised.popleft()
        number = len(self._raised)
        if self._flood_since is None and number > FLOOD:
            self._flood_since = time
            log.warning("alarm flood began", raised=number, minutes=LATELY / 60)
        elif self._flood_since is not None and number < FLOOD_ENDS:
            self._flood_since = None
            log.info("alarm flood ended", raised=number, minutes=LATELY / 60)

    def document(self) -> Mapping[str, object]:
        """Returns the status document."""
        since = self._flood_since
        flood = None if since is None else rfc3339(since)
        return {**self.counts(), "raised_in_10_min": len(self._raised), "flood_since": flood}
