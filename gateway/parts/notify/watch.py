"""The notices of one rule: a comparison of the open alarms with those that it has sent.

It does no I/O and has no clock. It goes by the state of the alarms, not by their events: what
happened while the gateway was off, or a message waited, is said as it is now.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, time
from enum import StrEnum
from typing import Any, NamedTuple

from gateway.parts.notify.settings import Rule

# Seconds: a line that fails raises several alarms.
GATHER = 2.0
Alarm = Mapping[str, Any]  # the document of an alarm
_UNACKNOWLEDGED, _IN_ALARM = ("active", "returned"), ("active", "acknowledged")


class What(StrEnum):
    """The event of an alarm in a message."""

    RAISED = "raised"
    WAITS = "not acknowledged"  # for as long as `after` of the rule
    AGAIN = "still active"
    ENDED = "ended"
    TEST = "test"


class Notice(NamedTuple):
    """One alarm in a message."""

    what: What
    alarm: Alarm


TEST = Notice(
    What.TEST,
    {
        "alarm": "this gateway",
        "state": "normal",
        "priority": "low",
        "text": "only a test of this way",
        "value": None,
        "raised": None,
    },
)


@dataclass(slots=True)
class Told:
    """An alarm that the rule has sent. `at`: by the clock of the loop."""

    raised: str
    at: float
    ended: bool = False


class Watch:
    """One rule, with the alarms that it has sent. As many as there are open alarms."""

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.told: dict[str, Told] = {}
        self._seen: dict[str, tuple[str, float]] = {}  # raised, and since when it waits
        self._began: float | None = None  # there is something to send since then
        self._sent_at = float("-inf")

    def look(
        self,
        alarms: Mapping[str, Alarm],
        gone: Callable[[str], Alarm | None],
        now: float,
        clock: datetime,
    ) -> list[Notice]:
        """Returns what to send now, and takes it as sent.

        `alarms`: those that are not normal; `gone`: returns another one; `clock`: the time of the
        day, with its zone.
        """
        found = [*self._of_open(alarms, now, clock), *self._of_gone(alarms, gone)]
        if not found or not self._is_on(clock):
            self._began = None
            return []
        if self._began is None:
            self._began = now
        if now < max(self._began + GATHER, self._sent_at + self.rule.pause):
            return []
        self._began, self._sent_at = None, now
        for what, alarm in found:
            ended = what is What.ENDED
            self.told[alarm["alarm"]] = Told(str(alarm["raised"]), now, ended=ended)
            if ended and alarm["alarm"] not in alarms:
                del self.told[alarm["alarm"]]
        return found

    def _of_open(self, alarms: Mapping[str, Alarm], now: float, clock: datetime) -> list[Notice]:
        rule, found = self.rule, list[Notice]()
        self._seen = {key: seen for key, seen in self._seen.items() if key in alarms}
        for key, alarm in alarms.items():
            if not rule.concerns(key, alarm["priority"]):
                continue
            raised, state, told = str(alarm["raised"]), alarm["state"], self.told.get(key)
            if told is None or told.raised != raised:
                if self._seen.get(key, ("", 0.0))[0] != raised:
                    self._seen[key] = raised, now - self._age(raised, clock)
                waited = now - self._seen[key][1]
                if state in _UNACKNOWLEDGED and waited >= rule.after:
                    found.append(Notice(What.WAITS if rule.after else What.RAISED, alarm))
            elif state not in _IN_ALARM:
                if rule.ended and not told.ended:
                    found.append(Notice(What.ENDED, alarm))
            elif state == "active" and rule.again is not None and now - told.at >= rule.again:
                found.append(Notice(What.AGAIN, alarm))
        return found

    def _of_gone(
        self, alarms: Mapping[str, Alarm], gone: Callable[[str], Alarm | None]
    ) -> list[Notice]:
        found = list[Notice]()
        for key in [key for key in self.told if key not in alarms]:
            alarm = gone(key)
            if alarm is not None and alarm["state"] != "normal":
                continue  # behind the end of the list
            of_operators = ("part_of", "shelved", "out_of_service")
            is_end = alarm is not None and not any(one in alarm for one in of_operators)
            if alarm is not None and is_end and not _has_ended(alarm):
                continue
            if alarm is not None and is_end and self.rule.ended and not self.told[key].ended:
                found.append(Notice(What.ENDED, alarm))
            else:
                del self.told[key]
        return found

    def _age(self, raised: str, clock: datetime) -> float:
        """Returns how long the alarm waits already, as far as the clock can be trusted."""
        try:
            age = (clock - datetime.fromisoformat(raised)).total_seconds()
        except ValueError:
            return 0.0
        return min(max(0.0, age), self.rule.after)

    def _is_on(self, clock: datetime) -> bool:
        """True at the time of the day. A night belongs to the day on which it begins."""
        day, between = clock.weekday(), self.rule.between
        if between is not None:
            begin, end = between
            at = time(clock.hour, clock.minute, clock.second)
            is_night = end <= begin
            if not (at >= begin or at < end if is_night else begin <= at < end):
                return False
            if is_night and at < end:
                day = (day - 1) % 7
        return day in self.rule.days


def _has_ended(alarm: Alarm) -> bool:
    """False if that is not known: the part with the alarms has begun again."""
    is_reached = "/" not in alarm["alarm"] and alarm["value"] is True
    return alarm.get("quality") != "bad" and not is_reached
