"""A small plant behind two routers: one router and one gateway are killed.

`python -m benchmarks.plant` does the same with ten gateways and 100,000 tags.
"""

import asyncio
import signal
from pathlib import Path

from benchmarks.plant import Plant, Seen, Sizes, event, watch

SIZES = Sizes(gateways=3, routers=2, lines=1, devices=2, tags=20, every=1.0)


async def test_a_consumer_shows_nothing_wrong_while_a_router_and_a_gateway_are_lost(
    tmp_path: Path,
) -> None:
    async with Plant(SIZES, tmp_path) as plant:
        consumer = await plant.consumer(1)
        names = ["g0", "g1"]
        for place, name in enumerate(names):
            plant.start_gateway(name, place)
        plant.start_gateway("g2", 0, mode="peer")
        seen = [await watch(consumer, SIZES, names)]
        await asyncio.to_thread(plant.gateways["g2"].says, "several routers", "mode to client")

        def returned(seen: Seen) -> bool:
            """Its devices were offline for a moment, and are online again."""
            numbers = [number for _, number in seen.numbers("g0", "devices")]
            return 0 in numbers and numbers[-1] == SIZES.devices

        before = len(plant.gateways["g0"].lines)
        await plant.kill_router(0)  # of g0, which may return before the consumer hears of it
        await asyncio.to_thread(plant.gateways["g0"].says, "Zenoh link up", after=before)
        seen.append(await watch(consumer, SIZES, names))
        assert plant.gateways["g0"].running

        await asyncio.to_thread(plant.gateways["g0"].end, signal.SIGKILL)
        plant.start_gateway("g0", 0)
        seen.append(await watch(consumer, SIZES, names, until=returned))
        assert event("g0", 0.0, ["g0"], SIZES, seen[-1]).unknown == SIZES.of_gateway
        assert sum(one.counted("wrong") for one in seen) == 0
        assert sum(one.counted("good") for one in seen) > 0
