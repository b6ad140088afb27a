"""Faults of the gateway itself are alarms: people are told of them, and of their end."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import pytest
from structlog.testing import capture_logs

from gateway.config import built
from gateway.errors import GatewayError
from gateway.parts.alarms.own_faults import DELAY, FAULTS, GATEWAY
from gateway.parts.alarms.part import FAULTS_EVERY, AlarmPart
from gateway.parts.notify import part as notify
from gateway.parts.notify.message import Message
from gateway.parts.registry import kinds
from gateway.plant.part import Phase
from gateway.plant.plant import Plant
from gateway.service.bulkheads import PAUSE_FIRST, Bulkheads
from tests.contract.test_codes import PAGE
from tests.parts.made import Silent, find
from tests.sim.virtual import on_virtual_time

DEVICE = {"protocol": "vigor", "tags": {"level": {"address": "D10"}}}


class Told(Silent):
    """A gateway without lines that run, whose messages are kept; `wrong`: its bad documents."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, **alarms: Any) -> None:
        self.sent: list[str] = []
        self.wrong: Mapping[str, Mapping[str, Any]] = {}

        async def send(message: Message) -> None:
            self.sent += message.text.split("\n\n")[0].splitlines()

        monkeypatch.setattr(notify, "ways", lambda *_: {"command": send})
        told = [f"{GATEWAY}{code}" for code in ("history", "no-router", "part-stopped")]
        rules = [{"to": ["command"], "alarms": told, "pause": "0s"}]
        section = {"command": ["/bin/true"], "rules": rules, "path": str(folder / "notify.json")}
        lines = {"hall": {"port": "simulator", "devices": {"mixer": DEVICE}}}
        kept = {"path": str(folder / "alarms.json"), **alarms}
        self.plant = Plant(built({"lines": lines, "notify": section, "alarms": kept}))
        self.parts = Bulkheads(self.plant)
        north: Any = self
        wanted = [(name, kind) for name, kind in kinds() if name in ("alarms", "notify")]
        self.parts.make(wanted, north)

    async def documents(self, _max_age: float) -> Any:
        return {"status": {"refused_devices": {}}, **self.parts.documents(), **self.wrong}

    async def __aenter__(self) -> Self:
        self.parts.activate()
        await self.parts.start(Phase.ACTIVE)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.parts.stop(*Phase)

    async def told(self, seconds: float) -> list[str]:
        await asyncio.sleep(seconds)
        sent, self.sent = [one.partition("; raised")[0] for one in self.sent], []
        return sent


@on_virtual_time
async def test_a_full_disk_and_a_lost_router_are_told_with_their_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    router: Mapping[str, Any] = {"connect": ["tcp/10.0.0.1:7447"], "to": []}
    both: Mapping[str, Mapping[str, Any]] = {
        "history": {"state": "the disk is full"},
        "zenoh": router,
    }
    async with Told(tmp_path, monkeypatch) as gateway:
        assert await gateway.told(60) == []
        gateway.wrong = both
        await gateway.told(DELAY - FAULTS_EVERY)
        gateway.wrong = {}  # a router that starts again is no alarm
        assert await gateway.told(60) == []
        gateway.wrong = both
        assert sorted(await gateway.told(30)) == [
            (
                "gateway:history raised; high priority; samples are not written; "
                "history: the disk is full"
            ),
            (
                "gateway:no-router raised; high priority; the gateway is not connected to Zenoh's "
                "router; Zenoh: not connected to tcp/10.0.0.1:7447: its clients get no values"
            ),
        ]
        gateway.wrong = {"zenoh": router}
        assert await gateway.told(30) == [
            "gateway:history ended; high priority; samples are not written"
        ]


@on_virtual_time
async def test_alarms_that_stopped_are_told_and_that_they_work_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was told before is not told again, and has not ended."""

    async def broken(_part: AlarmPart) -> None:
        raise GatewayError("broken")

    async with Told(tmp_path, monkeypatch) as gateway:
        gateway.wrong = {"history": {"state": "the disk is full"}}
        assert len(await gateway.told(30)) == 1
        with capture_logs(), monkeypatch.context() as patch:
            patch.setattr(AlarmPart, "begin", broken)
            [alarms] = [one for one in gateway.parts._all if one.name == "alarms"]
            alarms._fail(GatewayError("broken"))
            assert await gateway.told(6 * PAUSE_FIRST) == [
                (
                    "gateway:part-stopped raised; critical priority; a part of the gateway "
                    "stopped; alarms stopped: no alarm is raised until that part works again"
                )
            ]
        told = await gateway.told(20 * PAUSE_FIRST)
        assert [one for one in told if " ended" in one] == [
            "gateway:part-stopped ended; high priority; a part of the gateway stopped"
        ]


@on_virtual_time
async def test_each_fault_has_an_alarm_of_its_own_unless_the_file_wants_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tuned = {"priority": "low", "delay": "0s"}
    async with Told(tmp_path, monkeypatch, gateway=tuned) as gateway:
        gateway.wrong = {
            "status": {"refused_devices": {"oven": "other"}},
            "parts/web": {"why": "broken", "again": 5},
            "certificates/web.tls": {"file": "page.pem", "days": 3.0, "trouble": ""},
            "files/audit": {"trouble": "the disk is full"},
        }
        await gateway.told(2 * FAULTS_EVERY)
        page = find(gateway.parts, AlarmPart).page("active", None, 1000)
        found = {str(one["alarm"]): one for one in page["alarms"]}
        wanted = {"part-stopped", "certificate", "not-saved", "served-elsewhere"}
        assert {*found} == {f"{GATEWAY}{code}" for code in wanted}
        assert {one["priority"] for one in found.values()} == {"low"}
    async with Told(tmp_path, monkeypatch, gateway=False) as gateway:
        entries = find(gateway.parts, AlarmPart).entries()
        assert not [key for key, _ in entries if key.startswith(GATEWAY)]


async def test_what_a_full_disk_did_not_take_is_saved_when_it_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault "not saved" would last until the next message, and a kill would lose the queue."""
    path = tmp_path / "notify.json"
    path.mkdir()  # no file can have its name
    monkeypatch.setattr(notify, "LOOK_EVERY", 0.01)
    with capture_logs():
        async with Told(tmp_path, monkeypatch) as gateway, asyncio.timeout(300):
            part = find(gateway.parts, notify.NotifyPart)
            part._unsaved = True
            while not part.documents()["files/notify"]["trouble"]:
                await asyncio.sleep(0.01)
            path.rmdir()
            while part.documents()["files/notify"]["trouble"]:
                await asyncio.sleep(0.01)
    assert path.is_file()


def test_each_fault_of_the_page_of_codes_is_an_alarm() -> None:
    """Lines, devices and transfers have alarms of their own."""
    table = PAGE.read_text().partition("## Faults")[2].partition("## Warnings")[0]
    listed = {row.split("`")[1] for row in table.splitlines() if row.startswith("| `")}
    assert listed - {*FAULTS} == {"line-down", "device-silent", "transfer"}
