"""A client that may only read cannot keep writes from the PLC: they have places of their own."""

import asyncio
from pathlib import Path

import pytest

from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

READS, WRITES = 1500, 5
FLOODS: dict[str, tuple[str, bytes | None]] = {
    "peeks": ("plant/mixer/@peek", b"D100"),
    "fresh values": ("plant/mixer/recipe?max_age=0s", None),
    "all values": ("plant/**", None),
}


@pytest.mark.parametrize("read", FLOODS.values(), ids=FLOODS)
async def test_a_flood_of_reads_denies_no_write(
    read: tuple[str, bytes | None], tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    lines = {
        "hall": vigor_line(
            "simulator", {"recipe": {"address": "D500", "write": True}}, reply_timeout="2s"
        )
    }
    config = write_config(tmp_path / "plant.yaml", endpoint, lines)
    with await asyncio.to_thread(started, config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        async with (
            ZenohPeer("client", connect=[endpoint]) as reader,
            ZenohPeer("client", connect=[endpoint]) as writer,
        ):
            written = asyncio.Event()

            async def flood() -> int:
                rounds = 0
                while not written.is_set():
                    await reader.many([read] * READS)
                    rounds += 1
                return rounds

            flooding = asyncio.create_task(flood())
            for value in range(WRITES):
                many = (value + 1) * READS

                def flooded(known: dict[str, int], many: int = many) -> bool:
                    return known.get("queries", 0) > many  # missing in `busy`

                await writer.get_until("plant/@gateway/demo/zenoh", flooded)
                [reply] = await writer.get("plant/mixer/recipe/@set", b"%d" % value)
                assert reply.ok, reply.json
            written.set()
            assert await flooding >= WRITES - 1  # the writer's own queries were counted too
