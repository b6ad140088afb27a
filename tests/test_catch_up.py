"""History over Zenoh: asked by `_time`, and caught up by a consumer whose router was away."""

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gateway.history import Historian
from gateway.northbound import Mode, Northbound, ZenohSettings
from gateway.tags import Reason, bad, good
from tests.history_writer import WEEK, until
from tests.test_northbound import PlainDevice, PlainPlant, tag
from tests.zenoh_peer import ZenohPeer, free_endpoint

EXAMPLE = Path(__file__).parents[1] / "examples" / "catch_up.py"
SPEED = tag("mixer", "speed", history=True)
DOOR = tag("mixer", "door", history=True)
OTHER = tag("mixer", "other")
SECOND = 10**9
PAST = 1_795_262_400 * SECOND  # 2026-11-21T12:00:00Z


def plant() -> PlainPlant:
    return PlainPlant(PlainDevice("mixer", (SPEED, DOOR, OTHER)))


@asynccontextmanager
async def recording(path: Path) -> AsyncIterator[Historian]:
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    try:
        await asyncio.to_thread(until, historian, state="ok")
        yield historian
    finally:
        assert await asyncio.to_thread(historian.close)


@asynccontextmanager
async def serving(
    below: PlainPlant, historian: Historian, endpoint: str, *, listen: bool = False
) -> AsyncIterator[Northbound]:
    settings = ZenohSettings(
        mode=Mode.PEER,
        listen=(endpoint,) if listen else (),
        connect=() if listen else (endpoint,),
    )
    northbound = Northbound(settings, "demo", below, history=historian)
    serves = asyncio.create_task(northbound.run())
    try:
        async with asyncio.timeout(5):
            await northbound.opened.wait()
        yield northbound
    finally:
        serves.cancel()
        await asyncio.wait([serves], timeout=5)


async def test_history_is_answered_by_zenohs_time_ranges(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        recording(tmp_path / "h.db") as historian,
        serving(plant(), historian, endpoint, listen=True),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        historian.record(good(SPEED, n, PAST + n * SECOND) for n in range(1000))
        historian.record([bad(DOOR, Reason.NO_REPLY, PAST), good(DOOR, 7, PAST + SECOND)])

        async def asked(selector: str) -> list[object]:
            return [reply.json.get("value") for reply in await client.get(selector)]

        speed = "plant/mixer/speed?_time="
        assert await asked(f"{speed}[..]") == list(range(1000))
        assert await asked(f"{speed}[..]&limit=2".replace("&", ";")) == [0, 1]
        assert await asked(f"{speed}]2026-11-21T12:16:37Z..]") == [998, 999]
        assert await asked(f"{speed}[..2026-11-21T12:00:02Z[") == [0, 1]
        door = await client.get("plant/mixer/door?_time=[..]")
        assert [reply.json for reply in door] == [
            {
                "value": None,
                "quality": "bad",
                "reason": "no-reply",
                "time": "2026-11-21T12:00:00.000000Z",
            },
            {"value": 7, "quality": "good", "time": "2026-11-21T12:00:01.000000Z"},
        ]
        both = await client.get("plant/**?_time=[..2026-11-21T12:00:00Z]")
        assert sorted(str(reply.key) for reply in both) == ["plant/mixer/door", "plant/mixer/speed"]
        assert await asked("plant/mixer/other?_time=[..]") == []
        for wrong in ("[now(-1h);30m]", "yesterday", "[..]&limit=-1", "[..]&limit=many"):
            [reply] = await client.get(speed + wrong.replace("&", ";"))
            assert reply.json["error"] == "bad-query", wrong


class Poll:
    """A plant that goes on whatever the network does: 1, 2, 3 ... every 5 ms, all recorded."""

    def __init__(self, historian: Historian) -> None:
        self.plant = plant()
        self.told = 0
        self.northbound: Northbound | None = None
        self._historian = historian

    async def run(self) -> None:
        while True:
            self.told += 1
            sample = self.plant.now("mixer/speed", self.told)
            self._historian.record([sample])
            if self.northbound is not None:
                self.northbound.publish([sample])
            await asyncio.sleep(0.005)

    @asynccontextmanager
    async def on_air(self, endpoint: str) -> AsyncIterator[None]:
        async with serving(self.plant, self._historian, endpoint) as self.northbound:
            yield
            self.northbound = None


class Consumer:
    """The example in another process, and the lines it prints."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.lines: list[str] = []
        self._process = process
        self._arrived = asyncio.Event()
        self._listening = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.lines.append(line.decode().strip())
            self._arrived.set()

    async def knows(self, value: int) -> None:
        async with asyncio.timeout(30):
            while not any(line.endswith(f"speed {value}") for line in self.lines[-500:]):
                self._arrived.clear()
                await self._arrived.wait()

    async def end(self) -> None:
        self._process.kill()
        await asyncio.gather(self._process.wait(), self._listening)


@asynccontextmanager
async def polling_and_consuming(path: Path, endpoint: str) -> AsyncIterator[tuple[Poll, Consumer]]:
    async with recording(path) as historian:
        poll = Poll(historian)
        polling = asyncio.create_task(poll.run())
        midnight = time.strftime("%Y-%m-%dT00:00:00Z", time.gmtime())
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            str(EXAMPLE),
            *("--connect", endpoint, "--since", midnight),
            stdout=asyncio.subprocess.PIPE,
        )
        consumer = Consumer(process)
        try:
            yield poll, consumer
        finally:
            polling.cancel()
            await consumer.end()


def nothing_lost_and_nothing_twice(consumer: Consumer) -> None:
    speeds = [line.split() for line in consumer.lines if "plant/mixer/speed" in line]
    assert [int(words[2]) for words in speeds] == list(range(1, len(speeds) + 1))
    assert not any("late" in words for words in speeds)


async def test_a_consumer_loses_nothing_when_its_router_is_killed(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with polling_and_consuming(tmp_path / "h.db", endpoint) as (poll, consumer):
        async with poll.on_air(endpoint):
            for _ in range(3):
                async with ZenohPeer(Mode.ROUTER, listen=[endpoint]) as router:
                    await consumer.knows(poll.told + 50)
                    await router.kill()
                missed = poll.told + 50
                while poll.told < missed:
                    await asyncio.sleep(0.01)
            async with ZenohPeer(Mode.ROUTER, listen=[endpoint]):
                await consumer.knows(poll.told + 50)
        nothing_lost_and_nothing_twice(consumer)


async def test_a_consumer_loses_nothing_when_the_gateway_is_away(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        ZenohPeer(Mode.ROUTER, listen=[endpoint]),
        polling_and_consuming(tmp_path / "h.db", endpoint) as (poll, consumer),
    ):
        for _ in range(2):
            async with poll.on_air(endpoint):
                await consumer.knows(poll.told + 50)
        nothing_lost_and_nothing_twice(consumer)
