"""Clients ask for fresh values of a whole device all the time: its fast tag is still polled."""

import asyncio
from pathlib import Path

import pytest

from tests.e2e.processes import started, write_config
from tests.zenoh_peer import Received, ZenohPeer, free_endpoint

DEVICE = "plant/@gateway/demo/devices/plc"
SECONDS = 2.0


async def reads(client: ZenohPeer) -> int:
    """The reads of the fast tag so far."""
    [reply] = await client.get(DEVICE)
    [count] = [r["reads"] for r in reply.json["requests"] if r["every"] < 1.0]
    assert isinstance(count, int)
    return count


def is_good(sample: Received) -> bool:
    return bool(sample.json["quality"] == "good")


async def test_questions_for_fresh_values_leave_a_fast_tag_its_time(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    slow = {
        f"t{n}": {"address": f"holding:{n}", "every": "1h"}
        for start in (1000, 2000, 3000)
        for n in range(start, start + 80)
    }
    fast = {"fast": {"address": "holding:0", "every": "100ms"}}
    device = {"protocol": "modbus-rtu", "station": 1, "tags": fast | slow}
    line = {"port": "simulator", "baudrate": 9600, "devices": {"plc": device}}
    file = write_config(tmp_path / "c.yaml", endpoint, {"hall": line})
    with await asyncio.to_thread(started, file):
        async with (
            ZenohPeer("client", connect=[endpoint]) as client,
            ZenohPeer("client", connect=[endpoint]) as curious,
        ):
            values = await client.subscribe("plant/**", advanced=True)
            await values.until(lambda of: sum(map(is_good, of.latest().values())) > len(slow))
            before = await reads(client)
            await asyncio.sleep(SECONDS)
            alone = await reads(client) - before

            async def asks() -> None:
                while True:
                    await curious.many([("plant/plc/**?max_age=0s", None)] * 16)

            asking = asyncio.create_task(asks())
            before = await reads(client)
            await asyncio.sleep(SECONDS)
            beside = await reads(client) - before
            await curious.kill()
            with pytest.raises(ConnectionError):
                await asking
            assert beside > alone * 0.3, (beside, alone)


async def test_a_key_that_takes_for_ever_to_match_is_refused(tmp_path: Path) -> None:
    """Each `$*` more in one part of a key takes some twenty times as long, with all else held."""
    endpoint, name = free_endpoint(), "a" * 60
    device = {"protocol": "vigor", "station": 1, "tags": {name: {"address": "D1"}}}
    lines = {"hall": {"port": "simulator", "devices": {"plc": device}}}
    file = write_config(tmp_path / "c.yaml", endpoint, lines)
    with await asyncio.to_thread(started, file):
        async with ZenohPeer("client", connect=[endpoint]) as client:
            for options in ("", "?max_age=0s", "?_time=[..]"):
                [refused] = await client.get(f"plant/plc/{'$*a' * 12}$*b{options}")
                assert refused.json["error"] == "bad-query"
            [found] = await client.get("plant/plc/$*a$*")
            assert found.key == f"plant/plc/{name}"
