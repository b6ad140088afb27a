"""Routers that die: a small plant behind two of them, and a gateway with a client of its own.

`python -m benchmarks.plant` does the first with ten gateways and 100,000 tags.
"""

import asyncio
import signal
from pathlib import Path

import pytest

from benchmarks.plant import Plant, Seen, Sizes, event, watch
from tests.attacks.security_pages import user_of
from tests.e2e.processes import started, vigor_line, write_config
from tests.northbound.access import PASSWORDS, secret, users
from tests.zenoh_peer import ZenohPeer, free_endpoint

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


@pytest.mark.parametrize("guarded", [False, True])
async def test_a_client_of_the_gateway_gets_whole_answers_after_a_router_has_died(
    tmp_path: Path, guarded: bool
) -> None:
    """Zenoh keeps the route of a key that was asked through the router."""
    endpoint, at_router = free_endpoint(), free_endpoint()
    password = secret(tmp_path / "password.txt", PASSWORDS["gateway"])
    own = {"users_file": str(users(tmp_path)), "user": "gateway", "password_file": str(password)}
    file = write_config(
        tmp_path / "c.yaml",
        endpoint,
        {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})},
        zenoh={"prefix": "plant", "listen": [endpoint], "connect": [at_router]}
        | (own if guarded else {}),
    )
    user = user_of("viewer", PASSWORDS["viewer"]) if guarded else {}
    known = {"transport/auth/usrpwd/dictionary_file": own["users_file"]} if guarded else {}
    keys = ("plant/**", "plant/@gateway/demo/status", "plant/mixer/speed")

    async def answers(client: ZenohPeer) -> list[list[bool]]:
        return [[reply.ok for reply in await client.get(key, target="ALL")] for key in keys]

    async with ZenohPeer("router", listen=[at_router], config=known) as router:
        with await asyncio.to_thread(started, file) as program:
            for place in (at_router, endpoint):
                async with ZenohPeer("client", connect=[place], config=user) as client:
                    await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
                    assert await answers(client) == [[True]] * len(keys)
            await router.kill()
            await asyncio.to_thread(program.says, "Zenoh link down", "to=router")
            await asyncio.to_thread(program.says, "Zenoh link up", "to=peer")
            async with ZenohPeer("client", connect=[endpoint], config=user) as client:
                assert await answers(client) == [[True]] * len(keys)
