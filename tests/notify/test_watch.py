"""What one rule sends, and when: a table of stories in a time that the test sets."""

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from gateway.parts.notify.message import MOST, message
from gateway.parts.notify.settings import NotifySection, rules_of
from gateway.parts.notify.watch import GATHER, Notice, Told, Watch, What
from gateway.tags.timestamps import rfc3339

BEGIN = datetime(2026, 11, 23, 12, 0, tzinfo=UTC)  # a Monday


def alarm(key: str, state: str = "active", raised: float = 0.0, **more: Any) -> dict[str, Any]:
    at = rfc3339(round((BEGIN.timestamp() + raised) * 1e9))
    known = {"alarm": key, "state": state, "raised": at, "priority": "high", "text": "Tank full"}
    return {**known, "value": 91.0, "unit": "%", "level": "high", "limit": 90.0, **more}


class Plant:
    """Alarms, and one rule that looks at them each second."""

    def __init__(self, **rule: Any) -> None:
        settings = NotifySection.model_validate(
            {"command": ["/bin/true"], "rules": [{"to": ["command"], "pause": "0s", **rule}]}
        )
        (checked,) = rules_of(settings)
        self.watch = Watch(checked)
        self.alarms: dict[str, dict[str, Any]] = {}
        self.gone: dict[str, dict[str, Any]] = {}
        self.now = 0.0
        self.begin = BEGIN

    def put(self, *alarms: dict[str, Any]) -> None:
        for one in alarms:
            key = one["alarm"]
            self.alarms.pop(key, None)
            self.gone.pop(key, None)
            (self.gone if one["state"] == "normal" else self.alarms)[key] = one

    def until(self, end: float) -> list[tuple[float, str, str]]:
        """Returns what was sent: when, what, of which alarm."""
        found = []
        while self.now < end:
            self.now += 1
            clock = self.begin + timedelta(seconds=self.now)
            sent = self.watch.look(self.alarms, self.gone.get, self.now, clock)
            found += [(self.now, one.what.value, one.alarm["alarm"]) for one in sent]
        return found


def test_an_alarm_is_sent_once_with_its_end() -> None:
    plant = Plant()
    plant.put(alarm("a"), alarm("b"))
    assert plant.until(60) == [(1 + GATHER, "raised", "a"), (1 + GATHER, "raised", "b")]
    plant.put(alarm("a", "acknowledged"), alarm("b", "returned"))
    assert plant.until(120) == [(63, "ended", "b")]
    plant.put(alarm("a", "normal"), alarm("b", "normal"))
    assert plant.until(180) == [(123, "ended", "a")]
    assert not plant.watch.told


def test_an_alarm_that_is_raised_again_is_sent_again() -> None:
    plant = Plant()
    plant.put(alarm("a"))
    plant.until(10)
    plant.put(alarm("a", raised=9, level="high_high"))
    assert plant.until(20) == [(13, "raised", "a")]


@pytest.mark.parametrize("by", ["part_of", "shelved", "out_of_service"])
def test_what_an_operator_or_another_alarm_took_away_has_not_ended(by: str) -> None:
    plant = Plant()
    plant.put(alarm("a"))
    plant.until(10)
    plant.put({**alarm("a", "normal"), by: "somehow"})
    assert plant.until(30) == []
    plant.put(alarm("a", raised=30))
    assert plant.until(40) == [(33, "raised", "a")]


def test_an_alarm_that_a_file_has_no_longer_is_forgotten() -> None:
    plant = Plant()
    plant.put(alarm("a"))
    plant.until(10)
    plant.alarms.clear()
    assert plant.until(30) == []
    assert not plant.watch.told


def test_what_happens_during_the_pause_is_one_message() -> None:
    plant = Plant(pause="1min")
    plant.put(alarm("a"))
    assert plant.until(10) == [(3, "raised", "a")]
    plant.put(alarm("a", "returned"), alarm("b", raised=10), alarm("c", raised=11))
    plant.until(30)
    plant.put(alarm("c", "normal", raised=11))  # raised, ended, acknowledged: it is over
    assert plant.until(90) == [(63, "ended", "a"), (63, "raised", "b")]


def test_only_what_nobody_acknowledges_reaches_the_next_person() -> None:
    plant = Plant(after="10min", again="5min")
    plant.put(alarm("a"), alarm("b"))
    plant.until(300)
    plant.put(alarm("b", "acknowledged"))
    sent = plant.until(1300)
    assert sent == [
        (602, "not acknowledged", "a"),
        (904, "still active", "a"),
        (1206, "still active", "a"),
    ]
    plant.put(alarm("a", "acknowledged"))
    assert plant.until(3000) == []


def test_after_a_restart_an_alarm_has_waited_as_long_as_it_is_raised() -> None:
    plant = Plant(after="10min")
    plant.put(alarm("a", raised=-540), alarm("b", raised=-86400), alarm("c", raised=86400))
    assert plant.until(100) == [(3, "not acknowledged", "b"), (62, "not acknowledged", "a")]


def test_what_was_sent_before_a_restart_is_not_sent_again() -> None:
    plant = Plant()
    one = alarm("a")
    plant.watch.told["a"] = Told(one["raised"], -100.0)
    plant.put(one)
    assert plant.until(30) == []


@pytest.mark.parametrize(
    ("rule", "sent"),
    [
        ({"priority": "critical"}, []),
        ({"priority": "medium"}, ["mixer/level", "line:hall"]),
        ({"alarms": ["mixer/*"]}, ["mixer/level", "mixer/speed"]),
        ({"alarms": ["line:*", "oven"]}, ["line:hall"]),
        ({"days": ["tue"]}, []),
        ({"between": "11:00-13:00"}, ["mixer/level", "line:hall", "mixer/speed"]),
        ({"between": "13:00-11:00"}, []),
    ],
)
def test_a_rule_chooses(rule: dict[str, Any], sent: list[str]) -> None:
    plant = Plant(**rule)
    plant.put(alarm("mixer/level"), alarm("line:hall"), alarm("mixer/speed", priority="low"))
    assert [key for _, _, key in plant.until(10)] == sent


@pytest.mark.parametrize(
    ("hour", "is_on"), [(21, False), (22, True), (29, True), (30, False), (46, False)]
)
def test_a_night_belongs_to_the_day_on_which_it_begins(hour: int, is_on: bool) -> None:
    plant = Plant(between="22:00-06:00", days=["mon"])
    plant.begin = BEGIN + timedelta(hours=hour - 12)
    plant.put(alarm("a"))
    assert bool(plant.until(10)) is is_on


def test_an_open_alarm_is_sent_when_the_time_of_the_rule_begins() -> None:
    plant = Plant(between="12:10-13:00")
    plant.put(alarm("a"))
    assert plant.until(3600) == [(602, "raised", "a")]


def test_a_message_names_the_first_alarms_and_counts_the_others() -> None:
    notices = [Notice(What.RAISED, alarm(f"m/t{n}")) for n in range(MOST + 7)]
    long = message("plant", "demo", notices, 10**18)
    assert long.subject == f"[plant/demo] {MOST + 7} high raised"
    assert len(long.document["alarms"]) == MOST
    assert long.document["more"] == 7
    assert "and 7 more" in long.text
    one = message("plant", "demo", [Notice(What.ENDED, alarm("m/t", origin="simulated"))], 10**18)
    assert one.subject == "[plant/demo] m/t (simulated) ended: Tank full"
    assert "limit high 90; value 91 %" in one.text
