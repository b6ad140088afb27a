"""All alarms of a gateway: which samples are judged, timers of delays, lines and devices."""

import asyncio
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import orjson
import pytest
from structlog.testing import capture_logs

from gateway.config import load
from gateway.contract.faults import faults, warnings
from gateway.errors import Busy
from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.entry import Entry
from gateway.parts.alarms.file import AlarmFile, parse
from gateway.parts.alarms.machine import Event, State
from gateway.parts.alarms.part import AlarmPart
from gateway.plant.doors import Condition, Reading
from gateway.plant.plant import Plant
from gateway.tags import AlarmRule, Deadband, Level, Reason, Tag, bad, good
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder
from tests.e2e.processes import vigor_line, write_config
from tests.northbound.plant import tag
from tests.parts.made import alarms_of
from tests.sim.virtual import on_virtual_time

RULE = AlarmRule({Level.HIGH: 80}, hysteresis=5, delay=5)
SPEED = tag("mixer", "speed", alarm=RULE)
AT_ONCE = tag("mixer", "speed", alarm=AlarmRule({Level.HIGH: 80}), deadband=Deadband(5))
LEVEL = tag("mixer", "level")


class Board:
    """Alarms, and their changes."""

    def __init__(self, *tags: Tag) -> None:
        self.alarms = Alarms(tags, wall=lambda: 7)
        self.changes: list[tuple[str, Event | None]] = []
        self.alarms.subscribe(self._changed)

    def _changed(self, entry: Entry, event: Event | None) -> None:
        self.changes.append((entry.key, event))

    async def look(self) -> None:
        while True:
            self.alarms.look()
            await asyncio.sleep(1.0)

    def state(self, key: str = "mixer/speed") -> State:
        return self.alarms.entries[key].status.state

    def take(self, value: float, time: int = 1) -> None:
        self.alarms.judge([good(SPEED, value, time), good(LEVEL, 1, time)])


@on_virtual_time
async def test_a_delay_ends_although_the_value_is_sent_once() -> None:
    """A value that is published on change only, or a frame that arrives once."""
    board = Board(SPEED, LEVEL)
    board.take(85)
    await asyncio.sleep(4.9)
    assert board.state() is State.NORMAL
    await asyncio.sleep(0.2)
    assert board.state() is State.ACTIVE
    assert board.alarms.tally.counts() == {
        "normal": 0,
        "active": 1,
        "acknowledged": 0,
        "returned": 0,
        "shelved": 0,
        "out_of_service": 0,
    }


@on_virtual_time
async def test_a_jump_of_the_clock_ends_no_delay() -> None:
    board = Board(SPEED)
    board.take(85, time=10**18)
    board.take(86, time=10**18 + 3600 * 10**9)
    await asyncio.sleep(4.9)
    board.take(87, time=1)
    assert board.state() is State.NORMAL
    await asyncio.sleep(0.2)
    assert board.state() is State.ACTIVE


@on_virtual_time
async def test_bad_quality_is_reported_and_changes_no_state() -> None:
    board = Board(SPEED)
    board.take(85)
    await asyncio.sleep(6)
    for reason in (Reason.NO_REPLY, Reason.LINE_DOWN):
        board.alarms.judge([bad(SPEED, reason, 2)])
    assert board.state() is State.ACTIVE
    board.take(85)
    assert board.changes == [
        ("mixer/speed", None),  # good for the first time
        ("mixer/speed", Event.RAISED),
        ("mixer/speed", None),  # bad
        ("mixer/speed", None),  # good
    ]


def plant_of(folder: Path, tags: list[Tag]) -> tuple[Plant, AlarmPart]:
    """Returns a plant with these tags, and its alarms."""
    lines = {"hall": vigor_line("simulator", {"n": {"address": "D1"}})}
    plant = Plant(load(write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines)))
    plant.mirror = Mirror(tags, 0)
    plant.tags = lambda: tags  # type: ignore[method-assign]  # those of the test
    return plant, alarms_of(plant)


def _scans(tags: list[Tag], values: list[list[int]]) -> list[Any]:
    """Returns scans of one block, as the engine makes them."""
    decoder = Decoder(tags, range(len(tags)))
    scans = [decoder.first(values[0], 1)]
    for units in values[1:]:
        scans.append(decoder.after(scans[-1], units, 2))
    return scans


@on_virtual_time
async def test_each_read_is_judged_also_within_the_deadband(tmp_path: Path) -> None:
    gateway, part = plant_of(tmp_path, [AT_ONCE, LEVEL])
    entry = part.alarms.entries["mixer/speed"]
    for scan, state in zip(
        _scans([AT_ONCE, LEVEL], [[79, 0], [80, 0], [79, 0]]),
        (State.NORMAL, State.ACTIVE, State.RETURNED),
        strict=True,
    ):
        gateway.samples(scan)
        assert entry.status.state is state


@on_virtual_time
async def test_a_scan_without_alarms_costs_one_look(tmp_path: Path) -> None:
    """However many alarms other blocks have."""
    others = [tag("mixer", f"n{number}") for number in range(50)]
    gateway, _ = plant_of(tmp_path, [SPEED, *others])
    plain, alarmed = _scans(others, [[1] * 50] * 3), _scans([SPEED], [[1], [2], [3]])
    gateway.samples(plain[0])
    gateway.samples(alarmed[0])
    calls = {
        "plain": _calls(gateway.samples, plain[1]),
        "alarmed": _calls(gateway.samples, alarmed[1]),
    }
    assert calls["plain"] == 1 < calls["alarmed"]


def _calls(function: Any, scan: Any) -> int:
    found = 0

    def profile(frame: FrameType, event: str, _: Any) -> None:
        nonlocal found
        found += event == "call" and "gateway/parts/alarms/" in frame.f_code.co_filename

    sys.setprofile(profile)
    try:
        function(scan)
    finally:
        sys.setprofile(None)
    return found


@on_virtual_time
async def test_a_line_is_an_alarm_and_its_devices_hold() -> None:
    board = Board()
    line, device = [Reading(False)], [Reading(False)]
    rule = AlarmRule({Level.DOWN: True}, delay=3.0)
    silent = AlarmRule({Level.OFFLINE: True})
    board.alarms.watch(
        {
            "line:hall": Condition(rule, lambda: line[0]),
            "mixer": Condition(silent, lambda: device[0]),
        }
    )
    running = asyncio.create_task(board.look())
    await asyncio.sleep(1)
    device[0] = Reading(True, "no byte came back")
    await asyncio.sleep(2)
    assert board.state("mixer") is State.ACTIVE
    line[0], device[0] = Reading(True, "no such port"), Reading(None)
    await asyncio.sleep(5)
    assert (board.state("line:hall"), board.state("mixer")) == (State.ACTIVE, State.ACTIVE)
    line[0], device[0] = Reading(False), Reading(False)
    await asyncio.sleep(2)
    assert (board.state("line:hall"), board.state("mixer")) == (State.RETURNED, State.RETURNED)
    running.cancel()


async def test_acknowledged_alarms_survive_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "alarms.json"
    before = Board(AT_ONCE)
    file = AlarmFile(path, before.alarms)
    async with file.kept():
        before.alarms.judge([good(AT_ONCE, 85, 5)])
        before.alarms.acknowledge("mixer/speed", "Ana", "hmi")
    after = Board(SPEED)
    restored = AlarmFile(path, after.alarms)
    await restored.restore()
    async with restored.kept():
        status = after.alarms.entries["mixer/speed"].status
        assert status == before.alarms.entries["mixer/speed"].status
        assert status.acknowledged is not None
        assert status.acknowledged.by == "Ana"
        assert after.alarms.tally.counts()["acknowledged"] == 1


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b'{"form": 2, "alarms": {}}', b'{"form": 1, "alarms": {"mixer/speed": {}}}'],
)
async def test_a_damaged_file_is_said_and_moved_aside(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "alarms.json"
    path.write_bytes(content)
    board = Board(SPEED)
    file = AlarmFile(path, board.alarms)
    with capture_logs() as logs:
        await file.restore()
        async with file.kept():
            assert board.state() is State.NORMAL
    assert logs[0]["event"] == "state file damaged"
    assert (tmp_path / "alarms.json.bad").read_bytes() == content
    assert orjson.loads(path.read_bytes()) == {"alarms": {}, "form": 1}


async def test_each_change_is_on_disk_at_once(tmp_path: Path) -> None:
    """A gateway that is killed has told no operator more than the disk knows for long."""
    path = tmp_path / "alarms.json"
    board = Board(AT_ONCE)
    file = AlarmFile(path, board.alarms)
    async with file.kept(), asyncio.timeout(300):
        board.alarms.judge([good(AT_ONCE, 85, 5)])
        for state, change in (
            ("active", lambda: None),
            ("acknowledged", lambda: board.alarms.acknowledge("mixer/speed", "Ana")),
        ):
            change()
            while f'"state": "{state}"'.encode() not in (
                path.read_bytes() if path.exists() else b""
            ):
                await asyncio.sleep(0.01)


async def test_an_acknowledgement_is_on_disk_when_it_is_answered(tmp_path: Path) -> None:
    path = tmp_path / "alarms.json"
    board = Board(AT_ONCE)
    file = AlarmFile(path, board.alarms)
    async with file.kept():
        board.alarms.judge([good(AT_ONCE, 85, 5)])
        for name in ("Ana", "Ana"):  # a repeat too
            board.alarms.acknowledge("mixer/speed", name)
            await file.keep()
            [status] = parse(orjson.loads(path.read_bytes())).values()
            assert status.state is State.ACKNOWLEDGED


async def test_a_disk_that_fails_is_a_fault_an_error_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.alarms.file.KEPT_WITHIN", 0.2)
    path = tmp_path / "alarms.json"
    in_the_way = tmp_path / "alarms.json.new"
    in_the_way.mkdir()
    board = Board(AT_ONCE)
    file = AlarmFile(path, board.alarms)
    async with file.kept():
        board.alarms.judge([good(AT_ONCE, 85, 5)])
        board.alarms.acknowledge("mixer/speed", "Ana")
        with pytest.raises(Busy, match="not on disk"):
            await file.keep()
        assert board.state() is State.ACKNOWLEDGED
        document = {"files/alarms": {"trouble": file.trouble}}
        [fault] = faults(document)
        assert fault.startswith("alarms not saved: ")
        in_the_way.rmdir()
        async with asyncio.timeout(300):
            while file.trouble:
                await asyncio.sleep(0.01)
        [status] = parse(orjson.loads(path.read_bytes())).values()
        assert status.state is State.ACKNOWLEDGED
        assert list(faults({"files/alarms": {"trouble": file.trouble}})) == []
        await file.keep()


@on_virtual_time
async def test_a_computed_tag_and_a_debounced_bit_have_alarms(tmp_path: Path) -> None:
    tags = {
        "a": {"address": "D1"},
        "twice": {"computed": "a * 2", "alarm": {"high": 80}},
        "door": {"address": "M1", "debounce": "1s", "alarm": {"on": True}},
    }
    lines = {"hall": vigor_line("simulator", tags)}
    gateway = Plant(load(write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)))
    alarms = alarms_of(gateway).alarms
    [one] = [tag for device in gateway.config.devices for tag in device.tags if tag.name == "a"]
    entry = alarms.entries["mixer/twice"]
    for value, state in ((39, State.NORMAL), (40, State.ACTIVE), (39, State.RETURNED)):
        gateway.samples([good(one, value, 1)])
        assert entry.status.state is state
    door = next(tag for device in gateway.config.devices for tag in device.tags if tag.origin.kept)
    [reads] = door.origin.inputs
    for value, at, state in (
        (False, 1, State.NORMAL),
        (True, 2, State.NORMAL),
        (True, 2 * 10**9, State.ACTIVE),
    ):
        gateway.samples([good(reads, value, at)])
        assert alarms.entries["mixer/door"].status.state is state


@on_virtual_time
async def test_more_than_ten_alarms_in_ten_minutes_are_a_flood() -> None:
    rule = AlarmRule({Level.HIGH: 80})
    tags = [tag("mixer", f"t{n}", alarm=rule) for n in range(12)]
    board = Board(*tags)

    def floods() -> list[str]:
        board.alarms.look()
        document: Any = board.alarms.tally.document()
        return list(warnings({"status": {"refused_devices": {}}, "alarms": document}))

    with capture_logs() as logs:
        for one in tags[:10]:
            await asyncio.sleep(10)
            board.alarms.judge([good(one, 85, 1)])
        assert floods() == []
        board.alarms.judge([good(one, 85, 1) for one in tags[10:]])
        [flood] = floods()
        assert "12 alarms in 10 min" in flood
        await asyncio.sleep(570)  # six are left
        assert len(floods()) == 1
        await asyncio.sleep(20)  # four
        assert floods() == []
    events = [one["event"] for one in logs if "flood" in one["event"]]
    assert events == ["alarm flood began", "alarm flood ended"]


@on_virtual_time
async def test_a_limit_may_be_the_value_of_another_tag(tmp_path: Path) -> None:
    """As docs/alarms.md has it: the alarm of a difference."""
    tags = {
        "level": {"address": "D1"},
        "most": {"address": "D2"},
        "over": {"computed": "level - most", "alarm": {"high": 0, "hysteresis": 2}},
    }
    lines = {"hall": vigor_line("simulator", tags)}
    gateway = Plant(load(write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)))
    entry = alarms_of(gateway).alarms.entries["mixer/over"]
    by_name = {tag.name: tag for device in gateway.config.devices for tag in device.tags}
    for level, most, state in (
        (50, 60, State.NORMAL),
        (50, 50, State.ACTIVE),
        (50, 51, State.ACTIVE),
        (50, None, State.ACTIVE),  # nobody knows
        (50, 52, State.RETURNED),
    ):
        limit = by_name["most"]
        known = bad(limit, Reason.NO_REPLY, 1) if most is None else good(limit, most, 1)
        gateway.samples([good(by_name["level"], level, 1), known])
        assert entry.status.state is state
