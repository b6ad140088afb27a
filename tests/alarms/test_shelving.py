"""Alarms that an operator has shelved or taken out of service."""

from pathlib import Path
from typing import Any

import orjson
import pytest

from gateway.errors import BadValue, NothingToAcknowledge
from gateway.parts.alarms.file import parse, snapshot
from gateway.parts.alarms.machine import Status, Suppression
from gateway.parts.alarms.orders import Do, parse_order
from gateway.parts.alarms.part import AlarmPart
from gateway.parts.alarms.settings import AlarmsSection
from gateway.tags import AlarmRule, Level, Reason, Tag, bad, good
from gateway.tags.mirror import Mirror
from tests.alarms.test_folding import Hall
from tests.northbound.plant import tag
from tests.sim.virtual import on_virtual_time

SPEED = tag("mixer", "speed", alarm=AlarmRule({Level.HIGH: 80}, text="too fast"))
SHELVE = {"by": "Ana", "do": "shelve", "reason": "sensor broken", "seconds": 60}
REMOVE = {"by": "Ana", "do": "out-of-service", "reason": "line is rebuilt"}


class Desk(Hall):
    """A plant with one alarm of a tag, and what an operator orders."""

    def __init__(self, folder: Path, *tags: Tag, wall: int = 10**18, **sections: Any) -> None:
        super().__init__(folder, **sections)
        self.wall = wall
        found = tags or (SPEED,)
        self.plant.mirror = Mirror(found, 0)
        self.plant.tags = lambda: found  # type: ignore[method-assign]  # those of the test
        self.plant.wall = lambda: self.wall + round(self.now * 1e9)  # type: ignore[method-assign]
        self.make()

    def make(self) -> None:
        self.part = AlarmPart(self.part._core)  # as after a restart
        self.alarms = self.part.alarms
        self.alarms.subscribe(self._changed)
        self.part._watch()

    def take(self, value: float | None) -> None:
        time = self.plant.wall()
        sample = bad(SPEED, Reason.NO_REPLY, time) if value is None else good(SPEED, value, time)
        self.alarms.judge([sample])

    async def order(self, order: dict[str, Any], key: str = "mixer/speed") -> dict[str, Any]:
        return orjson.loads(await self.part.order(key, orjson.dumps(order), "hmi"))  # type: ignore[no-any-return]

    def restart(self, wall: int | None = None) -> None:
        kept = snapshot(self.alarms.statuses())
        self.wall = self.wall if wall is None else wall
        self.make()
        self.alarms.restore(parse(orjson.loads(kept)))

    @property
    def speed(self) -> dict[str, Any]:
        return self.document("mixer/speed")


@on_virtual_time
async def test_a_shelved_alarm_raises_nothing_until_its_time_ends(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    desk.take(85)
    document = await desk.order(SHELVE)
    assert (document["state"], document["level"]) == ("normal", None)
    what = document["shelved"]
    assert (what["by"], what["reason"], what["via"]) == ("Ana", "sensor broken", "hmi")
    assert what["until"] > what["time"]
    counts = desk.part.documents()["alarms"]
    assert (counts["normal"], counts["active"], counts["shelved"]) == (5, 0, 1)
    assert [one["alarm"] for one in desk.part.page("suppressed", None, 9)["alarms"]] == [
        "mixer/speed"
    ]
    assert [one["alarm"] for one in desk.part.shown()["alarms"]["suppressed"]] == ["mixer/speed"]
    with pytest.raises(NothingToAcknowledge, match="shelved"):
        await desk.order({"by": "Bo"})
    for value in (70, 85, 90, None, 91):
        desk.take(value)
        await desk.wait(1)
    assert desk.events() == ["mixer/speed raised", "mixer/speed shelved"]
    await desk.wait(60)
    assert desk.events() == ["mixer/speed unshelved", "mixer/speed raised"]
    assert (desk.speed["state"], "shelved" in desk.speed) == ("active", False)


@on_virtual_time
async def test_a_shelved_alarm_that_is_well_comes_back_normal(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    desk.take(85)
    await desk.order(SHELVE)
    desk.take(70)
    for _ in range(2):  # a repeat changes nothing
        document = await desk.order({"by": "Bo", "do": "unshelve"})
        assert (document["state"], "shelved" in document) == ("normal", False)
    assert desk.events() == ["mixer/speed raised", "mixer/speed shelved", "mixer/speed unshelved"]
    desk.take(85)
    assert desk.speed["state"] == "active"


@on_virtual_time
async def test_an_alarm_is_out_of_service_until_it_is_put_back(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    document = await desk.order(REMOVE)
    assert document["out_of_service"]["reason"] == "line is rebuilt"
    desk.take(85)
    await desk.wait(200)
    desk.restart()
    desk.take(85)
    assert (desk.speed["state"], "out_of_service" in desk.speed) == ("normal", True)
    with pytest.raises(BadValue, match="out of service: send do: in-service"):
        await desk.order({"by": "Bo", "do": "unshelve"})
    document = await desk.order({"by": "Bo", "do": "in-service"})
    assert (document["state"], desk.events()[-1]) == ("active", "mixer/speed raised")


@pytest.mark.parametrize(
    ("jump", "left"),
    [
        (0, 60),
        (30, 30),
        (3600, 1),  # its time ended meanwhile
        (-(10**8), 60),  # the clock was set back: it is not shelved for years
    ],
)
@on_virtual_time
async def test_a_shelved_alarm_survives_a_restart_with_its_end(
    tmp_path: Path, jump: int, left: int
) -> None:
    desk = Desk(tmp_path)
    desk.take(85)
    await desk.order(SHELVE)
    desk.restart(desk.wall + jump * 10**9)
    desk.take(85)
    desk.events()
    await desk.wait(left - 1)
    assert desk.events() == []
    await desk.wait(2)
    assert desk.events() == ["mixer/speed unshelved", "mixer/speed raised"]


@on_virtual_time
async def test_an_alarm_stays_shelved_when_the_file_changes_its_limit(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    await desk.order(SHELVE)
    await desk.order(SHELVE, "pump1")
    other = tag("mixer", "speed", alarm=AlarmRule({Level.HIGH: 60}))
    desk.alarms.take_over([other], [SPEED])
    settings = AlarmsSection.model_validate({"devices": {"delay": "9s"}})
    desk.part._settings = settings  # of the changed file
    desk.part._watch()
    assert ("shelved" in desk.speed, "shelved" in desk.document("pump1")) == (True, True)
    assert desk.part.documents()["alarms"]["shelved"] == 2
    await desk.wait(62)
    assert ("shelved" in desk.speed, "shelved" in desk.document("pump1")) == (False, False)


@on_virtual_time
async def test_a_shelved_line_hides_its_devices_and_a_shelved_device_stays_shelved(
    tmp_path: Path,
) -> None:
    desk = Desk(tmp_path)
    await desk.order(REMOVE, "pump1")
    desk.falls(1, 2, 3)
    await desk.wait(1)
    await desk.order(SHELVE, "line:hall")
    await desk.wait(20)
    assert desk.states() == "normal normal normal normal"
    assert desk.document("pump2")["part_of"] == "line:hall"
    await desk.wait(50)
    assert desk.states() == "active normal normal normal"
    desk.replies(2)
    await desk.wait(30)
    assert desk.states() == "returned normal normal active"


@on_virtual_time
async def test_each_order_is_a_row_of_the_journal_and_of_the_audit(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    told: list[dict[str, Any]] = []

    others: Any = desk.part._core.others
    others.audit = lambda _at, event: told.append(orjson.loads(event))
    desk.take(85)
    for order in (SHELVE, {"by": "Bo", "do": "unshelve"}, REMOVE, {"by": "Cy", "do": "in-service"}):
        await desk.order(order)
    assert {(one["event"], one["state"], one["via"]) for one in told} == {
        ("ended", "normal", "hmi")
    }
    assert [(one["change"], one["by"]) for one in told] == [
        *(("shelved", "Ana"), ("unshelved", "Bo")),
        *(("out of service", "Ana"), ("in service", "Cy")),
    ]
    assert desk.speed["state"] == "active"


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ({"do": "shelve", "seconds": 9}, "the reason is missing"),
        ({"do": "shelve", "reason": " "}, "the reason is missing"),
        ({"do": "shelve", "reason": "r"}, "from 1 to 60: shelving has an end"),
        ({"do": "shelve", "reason": "r", "seconds": 61}, "from 1 to 60"),
        ({"do": "shelve", "reason": "r", "seconds": True}, "from 1 to 60"),
        ({"do": "shelve", "reason": "r", "seconds": "60"}, "from 1 to 60"),
        ({"do": "shelve", "reason": "r" * 201, "seconds": 9}, "longer than 200"),
        ({"do": "shelve", "reason": "a\nb", "seconds": 9}, "not printable"),
        ({"do": "out-of-service"}, "the reason is missing"),
        ({"do": "hide"}, "do is none of acknowledge, shelve"),
        ({"do": ["shelve"]}, "do is none of"),
        ({"do": "unshelve", "by": ""}, "name of the operator is missing"),
        ({"for": 60}, "is no acknowledgement"),
    ],
)
def test_what_an_order_lacks_is_said(order: dict[str, Any], why: str) -> None:
    with pytest.raises(BadValue, match=why):
        parse_order(orjson.dumps({"by": "Ana"} | order), 60.0)


def test_without_do_an_order_is_an_acknowledgement() -> None:
    assert parse_order(b'{"by": "Ana"}', 60.0).do is Do.ACKNOWLEDGE


@pytest.mark.parametrize("until", [-1, "soon", 2**63])
def test_a_damaged_end_of_shelving_is_damage(until: object) -> None:
    status = Status(suppressed=Suppression("Ana", 1, "why", 2))
    document = orjson.loads(snapshot({"mixer/speed": status}))
    assert parse(document) == {"mixer/speed": status}
    document["alarms"]["mixer/speed"]["suppressed"]["until"] = until
    with pytest.raises(ValueError, match="is no time"):
        parse(document)
