"""Bulkheads: a part that fails ends nothing else, is said, and comes back."""

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest
from structlog.testing import capture_logs

from gateway.config import Config, built
from gateway.contract.faults import faults
from gateway.contract.interfaces import Keyed
from gateway.errors import Busy, ConfigError
from gateway.parts import registry
from gateway.plant.part import Core, Kind, Part, Phase, Remembers
from gateway.plant.plant import Plant
from gateway.service.bulkheads import CALL_WITHIN, PAUSE_FIRST, PAUSE_LONGEST, Bulkheads
from gateway.tags import Quality, Sample, Tag
from tests.parts.made import Silent
from tests.sim.virtual import on_virtual_time
from tests.writing import write

DATA: dict[str, Any] = {
    "lines": {
        "hall": {
            "port": "simulator",
            "devices": {
                "mixer": {
                    "protocol": "vigor",
                    "tags": {
                        "level": {"address": "D10", "every": "500ms", "alarm": {"high": -1}},
                        "recipe": {"address": "D500", "write": True},
                    },
                }
            },
        }
    }
}
POINTS = ("make", "restore", "begin", "run", "seen", "publish", "set_online", "retag", "take_over")
COMES_BACK = 6 * PAUSE_FIRST  # seconds: the pauses after a few failures
HANGS = ("restore", "begin", "take_over")


@dataclass
class Toy:
    """A part with every capability. It breaks where `breaks` says, or hangs where `hangs` says."""

    breaks: str = ""
    hangs: str = ""
    calls: list[str] = field(default_factory=list)

    def kind(self, phase: Phase = Phase.ACTIVE) -> Kind:
        def make(core: Core) -> Part:
            if self.calls:  # the first one is made before the gateway starts
                self.meet("make")
            self.calls.append("made")
            return self

        return Kind(make, phase)

    def meet(self, point: str) -> None:
        self.calls.append(point)
        if point == self.breaks:
            raise ZeroDivisionError(f"broken in {point}")

    async def wait_at(self, point: str) -> None:
        self.meet(point)
        if point == self.hangs:
            await asyncio.Event().wait()

    async def restore(self) -> None:
        await self.wait_at("restore")

    async def begin(self) -> None:
        await self.wait_at("begin")

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        await self.wait_at("take_over")

    async def run(self) -> None:
        self.meet("run")
        if self.breaks == "make":
            raise ZeroDivisionError("broken in run, to be made again")
        await asyncio.Event().wait()

    @property
    def wants(self) -> bool:
        return True

    def seen(self, samples: Sequence[Sample]) -> None:
        self.meet("seen")

    def publish(self, samples: Sequence[Sample]) -> None:
        self.meet("publish")

    def set_online(self, device: str, online: bool) -> None:
        self.meet("set_online")

    def retag(self, tags: Sequence[Tag], gone: Sequence[Tag]) -> None:
        self.meet("retag")

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return {"toy": {"calls": len(self.calls)}}


class Running:
    """A plant with one simulated line, and parts."""

    def __init__(self, *kinds: tuple[str, Kind]) -> None:
        self.plant = Plant(built(DATA))
        self.parts = Bulkheads(self.plant)
        self.plant.subscribe(self.parts)
        silent: Any = Silent()
        self.parts.make(kinds, silent)
        self.recipe, self.level = self._tag("recipe"), self._tag("level")

    def _tag(self, name: str) -> Tag:
        found = self.plant.tag(f"mixer/{name}")
        assert found is not None
        return found

    async def start(self) -> None:
        await self.parts.restore()
        await self.parts.start(Phase.KEEPING, Phase.SHOWING)
        self.parts.activate()
        await self.parts.start(Phase.ACTIVE, Phase.DRIVING)
        self.tasks = [asyncio.create_task(line.run()) for line in self.plant.lines]

    async def stop(self) -> None:
        await self.parts.stop(*Phase)
        for task in self.tasks:
            assert not task.done()
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)

    async def works(self) -> None:
        """Values flow, and a write is acknowledged."""
        before = self.plant.sample(self.level).time
        await asyncio.sleep(1.0)
        now = self.plant.sample(self.level)
        assert now.quality is Quality.GOOD
        assert now.time >= before
        assert (await write(self.plant, self.recipe, 7)).value == 7

    def said(self) -> list[str]:
        documents: Any = {**self.plant.status(), "zenoh": {}, "outcomes": {}}
        return [one for one in faults(documents) if "toy" in one]


@pytest.mark.parametrize("point", POINTS)
@on_virtual_time
async def test_a_part_that_fails_is_said_and_comes_back(point: str) -> None:
    toy = Toy(breaks=point)
    running = Running(("toy", toy.kind()))
    with capture_logs() as logs:
        await running.start()
        await running.works()
        running.parts._retag([], [])  # as a reload does; its caller needs a whole gateway
        await running.parts.take_over(running.plant.config, {})
        await running.works()
        if point == "make":
            await asyncio.sleep(PAUSE_FIRST)  # it fails in `run` first, and then when it is made
        # A part that failed before the start is tried again at once.
        assert running.said() or point == "restore"
        stopped = [one for one in logs if one["event"] == "part stopped"]
        assert {one["log_level"] for one in stopped} == {"error"}
        assert any(f"broken in {point}" in one["why"] for one in stopped)
        toy.breaks = ""
        await asyncio.sleep(COMES_BACK)
    assert running.said() == []
    assert toy.calls.count("made") >= 2
    await running.works()
    await running.stop()


@pytest.mark.parametrize("point", HANGS)
@on_virtual_time
async def test_a_part_that_hangs_holds_the_plant_up_for_seconds_only(point: str) -> None:
    toy = Toy(hangs=point)
    running = Running(("toy", toy.kind()))
    loop = asyncio.get_running_loop()
    with capture_logs():
        begun = loop.time()
        await running.start()
        await running.parts.take_over(running.plant.config, {})
        assert loop.time() - begun <= CALL_WITHIN + 0.1
        assert any("did not answer" in why for why in running.said())
        await running.works()
        toy.hangs = ""
        await asyncio.sleep(COMES_BACK)
    assert running.said() == []
    await running.stop()


@on_virtual_time
async def test_the_pause_between_two_tries_grows_to_minutes() -> None:
    toy = Toy(breaks="run")
    running = Running(("toy", toy.kind()))
    with capture_logs() as logs:
        await running.start()
        await asyncio.sleep(1200)
    count = len([one for one in logs if one["event"] == "part stopped"])
    assert 1200 / PAUSE_LONGEST < count < 1200 / PAUSE_FIRST / 20
    await running.stop()


@on_virtual_time
async def test_a_part_that_failed_takes_no_other_with_it() -> None:
    broken, sound = Toy(breaks="seen"), Toy()
    running = Running(("toy", broken.kind()), ("sound", sound.kind()))
    with capture_logs():
        await running.start()
        await running.works()
    calls = sound.calls.count("seen")
    await running.works()
    assert sound.calls.count("seen") > calls
    assert sound.calls.count("made") == 1
    await running.stop()


@pytest.mark.parametrize("name", registry.PARTS)
@on_virtual_time
async def test_the_plant_works_while_a_part_of_the_list_fails_at_once(name: str) -> None:
    """Each part in turn fails when it runs, and again when it is made again."""

    class Failing:
        async def run(self) -> None:
            raise OSError("the disk has gone")

    found = dict(registry.kinds())
    kind = Kind(lambda _: Failing(), found[name].phase, found[name].serves)
    running = Running(*[(each, kind if each == name else found[each]) for each in found])
    with capture_logs():
        await running.start()
        await running.works()
        await asyncio.sleep(COMES_BACK)
        await running.works()
        document: Any = running.plant.status()[f"parts/{name}"]
    assert document["why"] == "OSError: the disk has gone"
    assert document["failures"] > 1
    if kind.serves is Keyed:
        with pytest.raises(Busy, match="the disk has gone"):
            running.parts.keyed(name)
    if kind.serves is Remembers:
        with pytest.raises(Busy, match="the disk has gone"):
            running.parts.history()
    await running.stop()


def test_a_mistake_in_the_file_ends_the_start() -> None:
    def make(_: Core) -> Part:
        raise ConfigError("tokens_file /etc/tokens: no such file")

    with pytest.raises(ConfigError, match="no such file"):
        Running(("web", Kind(make)))


@on_virtual_time
async def test_documents_of_a_part_are_in_the_status() -> None:
    toy = Toy()
    running = Running(("toy", toy.kind()))
    await running.start()
    status: Any = running.plant.status()
    assert status["toy"]["calls"] > 0
    assert status["parts/toy"] == {"why": "", "again": None, "failures": 0, "faults": []}
    await running.stop()
