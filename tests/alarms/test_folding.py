"""One cause is one alarm: the devices of a silent line are part of the alarm of the line."""

import asyncio
from pathlib import Path
from typing import Any

import orjson
import pytest

from gateway.config import load
from gateway.contract.status import BACK, is_silent
from gateway.engine.device.health import State as Health
from gateway.errors import ConfigError, LineDown, NoReply, NothingToAcknowledge
from gateway.parts.alarms.board import OWN_AFTER
from gateway.parts.alarms.entry import Entry
from gateway.parts.alarms.file import parse, snapshot
from gateway.parts.alarms.machine import Alarm, Event, State
from gateway.parts.alarms.part import AlarmPart
from gateway.parts.alarms.settings import WatchedSection
from gateway.parts.alarms.watched import LINE_KNOWN
from gateway.plant.plant import Plant
from gateway.tags import AlarmRule, Level
from tests.e2e.processes import write_config
from tests.parts.made import alarms_of
from tests.sim.virtual import on_virtual_time

OFF = WatchedSection().off_delay
OFFLINE = AlarmRule({Level.OFFLINE: True})


def driven(alarm: Alarm, steps: str) -> list[Event]:
    """Returns the events of steps: 1 silent, 0 replies, ? not known, A acknowledged, ( part of
    another alarm, ) no longer, R restarted."""
    events: list[Event | None] = []
    for now, step in enumerate(steps):
        match step:
            case "1" | "0":
                events += [alarm.elapse(now, now), alarm.judge(step == "1", now, now)]
            case "?":
                events += [alarm.elapse(now, now)]
                alarm.suspend(now)
            case "A":
                events += [alarm.acknowledge("Ana", now)]
            case "(":
                events += [alarm.fold(now)]
            case ")":
                events += [alarm.unfold(now, now)]
            case "R":
                [status] = parse(orjson.loads(snapshot({"plc": alarm.status}))).values()
                alarm.__init__(alarm.rule)  # type: ignore[misc]  # the process ends
                alarm.restore(status)
    return [event for event in events if event is not None]


@pytest.mark.parametrize(
    ("steps", "events", "state", "by"),
    [
        ("1(", "raised folded", "normal", None),
        ("1(1)", "raised folded raised", "active", None),
        ("1A(1)", "raised acknowledged folded unfolded", "acknowledged", "Ana"),
        ("1A(R1)", "raised acknowledged folded unfolded", "acknowledged", "Ana"),
        ("1(R1)", "raised folded raised", "active", None),
        ("1A(R?)", "raised acknowledged folded unfolded", "acknowledged", "Ana"),
        ("1(?)", "raised folded raised", "active", None),
        ("1A(0)", "raised acknowledged folded", "normal", "Ana"),
        ("1A(0)1", "raised acknowledged folded raised", "active", None),
        ("1A(01)", "raised acknowledged folded raised", "active", None),
        ("1A(R01)", "raised acknowledged folded raised", "active", None),
        ("1A0(1)", "raised acknowledged ended raised", "active", None),
        ("10(1)", "raised ended raised", "active", None),
        ("10(0)", "raised ended", "returned", None),
        ("10(A1", "raised ended acknowledged", "normal", "Ana"),
        ("(1)", "raised", "active", None),
        ("(10)", "", "normal", None),
        ("(1", "", "normal", None),
        ("1((1))", "raised folded raised", "active", None),
    ],
)
def test_an_alarm_that_is_part_of_another_one(
    steps: str, events: str, state: str, by: str | None
) -> None:
    alarm = Alarm(OFFLINE)
    assert " ".join(driven(alarm, steps)) == events
    known = alarm.status.acknowledged
    assert (alarm.status.state, known and known.by) == (state, by)


def test_a_file_of_an_earlier_version_has_no_folded_alarms() -> None:
    alarm = Alarm(OFFLINE)
    driven(alarm, "1")
    document = orjson.loads(snapshot({"plc": alarm.status}))
    del document["alarms"]["plc"]["folded"]
    assert parse(document) == {"plc": alarm.status}


class Hall:
    """A line of real devices whose health a test decides, and the alarms of its plant."""

    def __init__(self, folder: Path, devices: int = 3, **sections: Any) -> None:
        tags = {"level": {"address": "holding:1"}}
        modbus = {"protocol": "modbus-rtu", "tags": tags}
        named = {f"pump{n}": {**modbus, "station": n} for n in range(1, devices + 1)}
        lines = {"hall": {"port": "simulator", "devices": named}}
        file = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines, **sections)
        self.plant = Plant(load(file))
        self.part: AlarmPart = alarms_of(self.plant)
        self.told: list[dict[str, Any]] = []
        self.part.alarms.subscribe(self._changed)
        [self.line] = self.plant.lines
        self.engine = self.line.engine
        self.devices = self.engine.devices
        self.open()

    def _changed(self, entry: Entry, event: Event | None) -> None:
        if event is not None:
            self.told.append({"event": str(event), **orjson.loads(self.part.document(entry))})

    def open(self) -> None:
        self.line.tried.set()
        self.engine.opened(self.now)

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def replies(self, *numbers: int) -> None:
        for number in numbers:
            self.devices[number - 1].health.answered()
            self.devices[number - 1].record.falls.rise(self.now)

    def falls(self, *numbers: int) -> None:
        for number in numbers:
            device = self.devices[number - 1]
            device.health.unclear(NoReply("no reply"), None, self.now)
            device.health.gave_up(self.now, 1.0)
            device.record.falls.fall(self.now)
            device.record.count_failure(NoReply("no reply"))

    def failing(self, *numbers: int) -> None:
        for number in numbers:
            self.devices[number - 1].health.unclear(NoReply("no reply"), None, self.now)

    async def wait(self, seconds: float) -> None:
        """Looks each second, as the part does."""
        for _ in range(int(seconds)):
            self.part._watch()  # its loop writes a file too
            self.part.alarms.look()
            await asyncio.sleep(1.0)

    def document(self, key: str) -> dict[str, Any]:
        return orjson.loads(self.part.document(self.part.alarms.entries[key]))  # type: ignore[no-any-return]

    def states(self) -> str:
        keys = ["line:hall", *(device.name for device in self.devices)]
        return " ".join(self.document(key)["state"] for key in keys)

    def events(self) -> list[str]:
        found = [f"{row['alarm']} {row['event']}" for row in self.told]
        self.told.clear()
        return found


@on_virtual_time
async def test_one_silent_line_is_one_alarm_and_the_devices_have_theirs_again(
    tmp_path: Path,
) -> None:
    hall = Hall(tmp_path)
    hall.replies(1, 2, 3)
    await hall.wait(BACK)
    hall.falls(1, 2)
    await hall.wait(2)
    assert hall.states() == "normal active active normal"
    hall.part.alarms.acknowledge("pump2", "Ana")
    hall.falls(3)  # the line or the device? That is known in a moment
    await hall.wait(2)
    assert hall.states() == "normal active acknowledged normal"
    hall.told.clear()
    await hall.wait(2)
    assert hall.states() == "active normal normal normal"
    line = hall.document("line:hall")
    assert (line["level"], line["text"]) == ("silent", "line hall is silent")
    assert line["detail"].startswith("all 3 devices are silent, no reply to 100% of the last 3 req")
    assert (line["value"], line["devices"]) == (True, ["pump1", "pump2", "pump3"])
    assert [row["part_of"] for row in hall.told[1:]] == ["line:hall"] * 2
    assert hall.part.documents()["alarms"]["raised_in_10_min"] == 1
    assert hall.events() == ["line:hall raised", "pump1 folded", "pump2 folded"]
    with pytest.raises(NothingToAcknowledge, match="part of line:hall: acknowledge that"):
        hall.part.alarms.acknowledge("pump1", "Ana")
    hall.part.alarms.acknowledge("line:hall", "Ana")
    assert "part_of" in hall.document("pump1")

    hall.replies(1)
    await hall.wait(BACK + OFF - 1)
    assert hall.states() == "acknowledged normal normal normal"
    await hall.wait(2)  # the line is back, and its devices have some seconds to follow it
    assert hall.states() == "normal normal normal normal"
    hall.events()
    hall.replies(3)
    await hall.wait(OWN_AFTER)
    assert hall.states() == "normal normal acknowledged normal"
    assert hall.events() == ["pump2 unfolded"]
    assert hall.document("pump2")["acknowledged"]["by"] == "Ana"
    assert "part_of" not in hall.document("pump1")
    hall.falls(3)
    await hall.wait(1)
    assert hall.states() == "normal normal acknowledged active"


@on_virtual_time
async def test_a_line_that_goes_down_takes_the_alarms_of_its_devices(tmp_path: Path) -> None:
    """Silent, down, silent again: one alarm of the line, and no device in between."""
    hall = Hall(tmp_path)
    hall.falls(1, 2, 3)
    await hall.wait(5)
    hall.engine.lost(LineDown("unplugged"), hall.now, 1)
    await hall.wait(5)
    assert hall.document("line:hall")["level"] == "down"
    assert hall.states() == "active normal normal normal"
    hall.events()
    hall.open()
    await hall.wait(1)
    hall.falls(1, 2, 3)
    await hall.wait(OFF + 1)
    assert hall.states() == "active normal normal normal"
    assert hall.document("line:hall")["level"] == "silent"
    assert hall.events() == ["line:hall eased"]


@on_virtual_time
async def test_a_silent_line_whose_port_was_opened_again_stays_silent(tmp_path: Path) -> None:
    hall = Hall(tmp_path)
    hall.falls(1, 2, 3)
    await hall.wait(5)
    hall.engine.lost(LineDown("opened again"), hall.now, 1)
    await hall.wait(1)
    hall.events()
    hall.open()
    await hall.wait(5)
    assert (hall.document("line:hall")["quality"], hall.states().split()[0]) == ("bad", "active")
    hall.falls(1, 2, 3)
    await hall.wait(5)
    assert hall.events() == []


@on_virtual_time
async def test_a_restart_in_the_middle_keeps_line_devices_and_acknowledgement(
    tmp_path: Path,
) -> None:
    before = Hall(tmp_path)
    before.replies(1, 2, 3)
    await before.wait(BACK)
    before.falls(1, 2)
    await before.wait(2)
    before.part.alarms.acknowledge("pump2", "Ana")
    before.falls(3)
    await before.wait(4)
    kept = snapshot(before.part.alarms.statuses())

    hall = Hall(tmp_path)
    hall.part._watch()
    hall.part.alarms.restore(parse(orjson.loads(kept)))
    await hall.wait(2 * OWN_AFTER)
    assert hall.states() == "active normal normal normal"
    hall.falls(1, 2, 3)
    await hall.wait(5)
    assert hall.events() == []
    hall.replies(1)
    await hall.wait(BACK + OFF + OWN_AFTER + 2)
    assert hall.states() == "returned normal acknowledged active"


@on_virtual_time
async def test_a_device_waits_some_seconds_for_the_others_of_its_line(tmp_path: Path) -> None:
    """32 devices fall silent one after the other: none of them is an alarm before the line is."""
    hall = Hall(tmp_path)
    hall.replies(1, 2, 3)
    hall.failing(2, 3)
    for number in (1, 2, 3):
        hall.falls(number)
        await hall.wait(4)
    assert hall.events() == ["line:hall raised"]
    other = Hall(tmp_path)
    other.replies(1, 2, 3)
    other.failing(2, 3)  # for long: who knows why
    other.falls(1)
    await other.wait(LINE_KNOWN + 2)
    assert other.events() == ["pump1 raised"]


@on_virtual_time
async def test_without_an_alarm_of_the_line_each_device_has_its_own(tmp_path: Path) -> None:
    hall = Hall(tmp_path, alarms={"lines": False})
    hall.falls(1, 2, 3)
    await hall.wait(20)
    assert {one.status.state for one in hall.part.alarms.entries.values()} == {State.ACTIVE}


@on_virtual_time
async def test_a_line_is_silent_if_no_device_replies_for_long(tmp_path: Path) -> None:
    hall = Hall(tmp_path, 2)
    seen = []
    for falling, replying, wait in (
        ((), (), 0.0),  # starting
        ((1,), (), 0.0),
        ((2,), (), 0.0),  # all
        ((), (1,), BACK - 0.1),  # a garbled line has such moments
        ((), (), 0.2),
        ((1,), (), 0.0),
        ((), (1, 2), 0.0),  # not known
        ((), (), BACK),
    ):
        hall.falls(*falling)
        hall.replies(*replying)
        await asyncio.sleep(wait)
        seen.append(is_silent(hall.engine, hall.now))
    assert seen == [None, None, True, True, False, True, None, False]
    assert {device.health.state for device in hall.devices} == {Health.ONLINE}


@on_virtual_time
async def test_one_device_is_no_silent_line(tmp_path: Path) -> None:
    hall = Hall(tmp_path, 1)
    hall.falls(1)
    await hall.wait(5)
    assert hall.states() == "normal active"


@pytest.mark.parametrize(
    ("setting", "mistake"),
    [
        ({"devices": {"delay": "10x"}}, "devices.delay: 10x: x is no unit of time"),
        ({"devices": {"prio": "high"}}, "devices.prio: no setting of devices: did you mean prio"),
        ({"lines": {"priority": "urgent"}}, "lines.priority: 'urgent' is not known: use critical"),
        ({"transfers": 3}, r"transfers: 3: write true, false or \{delay: 10s\}"),
    ],
)
def test_a_wrong_setting_of_alarms_is_said(
    tmp_path: Path, setting: dict[str, Any], mistake: str
) -> None:
    file = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {}, alarms=setting)
    with pytest.raises(ConfigError, match=f"alarms.{mistake}"):
        load(file)


@on_virtual_time
async def test_devices_have_the_delay_and_priority_of_the_file(tmp_path: Path) -> None:
    settings = {"delay": "7s", "off_delay": "2s", "priority": "low"}
    hall = Hall(tmp_path, alarms={"devices": settings, "lines": False})
    hall.replies(2, 3)
    await hall.wait(BACK)
    hall.falls(1)
    await hall.wait(6)
    assert hall.events() == []
    await hall.wait(2)
    for _ in range(3):  # a bad contact
        hall.replies(1)
        await hall.wait(1)
        hall.falls(1)
        await hall.wait(1)
    assert hall.events() == ["pump1 raised"]
    assert hall.document("pump1")["priority"] == "low"
    hall.replies(1)
    await hall.wait(3)
    assert hall.events() == ["pump1 ended"]
