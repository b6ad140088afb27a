"""History over Zenoh: asked by `_time`, and caught up by a consumer whose router was away."""

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("away", ["router", "gateway"])
async def test_a_consumer_catches_up_after_the_router_or_the_gateway_was_away(
    tmp_path: Path, away: str
) -> None:
    endpoint = free_endpoint()
    below = plant()
    told = 0

    async with recording(tmp_path / "h.db") as historian:
        face: list[Northbound] = []

        async def poll() -> None:
            """The plant goes on whatever the network does."""
            nonlocal told
            while True:
                told += 1
                sample = below.now("mixer/speed", told)
                historian.record([sample])
                for northbound in face:
                    northbound.publish([sample])
                await asyncio.sleep(0.005)

        @asynccontextmanager
        async def on_air() -> AsyncIterator[None]:
            async with serving(below, historian, endpoint) as northbound:
                face.append(northbound)
                try:
                    yield
                finally:
                    face.remove(northbound)

        polling = asyncio.create_task(poll())
        await asyncio.sleep(0.1)
        async with ZenohPeer(Mode.ROUTER, listen=[endpoint]) as router:
            async with on_air():
                consumer = await asyncio.create_subprocess_exec(
                    sys.executable,
                    str(EXAMPLE),
                    "--connect",
                    endpoint,
                    "--since",
                    time.strftime("%Y-%m-%dT00:00:00Z", time.gmtime()),
                    stdout=asyncio.subprocess.PIPE,
                )
                heard: list[str] = []

                async def listen() -> None:
                    assert consumer.stdout is not None
                    async for line in consumer.stdout:
                        heard.append(line.decode().strip())

                listening = asyncio.create_task(listen())

                async def caught_up() -> None:
                    """Until the consumer has what is told from now on."""
                    wanted = str(told + 1)
                    async with asyncio.timeout(30):
                        while not any(line.endswith(f"speed {wanted}") for line in heard):
                            await asyncio.sleep(0.02)

                await caught_up()
                if away == "router":
                    for _ in range(2):
                        await router.kill()
                        await asyncio.sleep(1.0)
                        router = ZenohPeer(Mode.ROUTER, listen=[endpoint])
                        await router.__aenter__()
                        await caught_up()
            if away == "gateway":
                await asyncio.sleep(0.5)
                async with on_air():
                    await caught_up()
        polling.cancel()
        consumer.kill()
        await asyncio.gather(consumer.wait(), listening)
    assert not [line for line in heard if line.endswith("late")]
    speeds = [int(line.split()[2]) for line in heard if line.split()[1] == "plant/mixer/speed"]
    assert speeds == list(range(1, len(speeds) + 1))
    assert len(speeds) > 150
