"""Several gateways behind a router with the rules of docs/access-control.md."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from gateway.config import ZenohConfig
from tests.northbound.access import (
    PASSWORDS,
    ROUTER_RULES,
    rules,
    secret,
    users,
)
from tests.northbound.plant import PlainPlant, mixer, northbound_of, running, until
from tests.zenoh_peer import ZenohPeer, free_endpoint


@asynccontextmanager
async def behind_a_router(plant: PlainPlant, folder: Path) -> AsyncIterator[tuple[Any, str]]:
    endpoint = free_endpoint()
    config = {
        "access_control": rules(ROUTER_RULES),
        "transport/auth/usrpwd/dictionary_file": str(users(folder)),
    }
    password = secret(folder / "password.txt", PASSWORDS["gateway"] + "\n")
    settings = ZenohConfig(connect=(endpoint,), user="gateway", password_file=password)
    async with ZenohPeer("router", listen=[endpoint], config=config):
        northbound = northbound_of(plant, settings)
        async with running(northbound):
            await until(lambda: northbound.counters()["links"] == 1)
            yield northbound, endpoint


async def test_behind_a_router_a_second_gateway_leaves_the_devices_to_the_first(
    tmp_path: Path,
) -> None:
    async with behind_a_router(mixer(), tmp_path) as (_, endpoint):
        settings = ZenohConfig(
            connect=(endpoint,), user="gateway", password_file=tmp_path / "password.txt"
        )
        second = northbound_of(mixer(), settings, name="second")
        serves = asyncio.create_task(second.run())
        async with asyncio.timeout(300):
            await second.admission.replaced.wait()
        assert second.admission.claiming.withheld == {"mixer": "demo", "oven": "demo"}
        assert not second.admission.active.is_set()
        serves.cancel()
        await asyncio.wait([serves])
