"""Refused puts of any program push no write out of the audit trail."""

import asyncio
from pathlib import Path

from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
WRITES, REFUSALS = 5, 330


async def test_the_audit_trail_keeps_the_writes(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    lines = {"hall": vigor_line("simulator", {"recipe": {"address": "D500", "write": True}})}
    history = {"path": "history.db", "max_size": "1MB"}
    config = write_config(tmp_path / "plant.yaml", endpoint, lines, history=history)
    with await asyncio.to_thread(started, config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            for value in range(WRITES):
                [reply] = await client.get(RECIPE, b"%d" % value)
                assert reply.ok
            for _ in range(REFUSALS):
                await client.put("plant/mixer/nothing/@set", b"1")
            # Some refusals are only counted, and summarised with the next status.
            summary = await asyncio.to_thread(gateway.says, "refusals suppressed", "unknown-tag")
            assert "count=" in summary
            await client.get_until(
                "plant/@gateway/demo/history", lambda status: status["refusals_stored"] > 300
            )
            past = await client.get(
                "plant/@gateway/demo/writes?_time=[now(-1h)..]", consolidation="NONE"
            )
            lines_of_trail = [reply.json for reply in past]
            written = [line["value"] for line in lines_of_trail if line["outcome"] == "written"]
            assert written == list(range(WRITES))
            told = [line for line in lines_of_trail if line["outcome"] == "unknown-tag"]
            [suppressed] = [line for line in lines_of_trail if line["outcome"] == "suppressed"]
            assert 90 <= len(told) <= 100  # the ring of refusals in a file of this size
            assert suppressed["kinds"] == {"unknown-tag": suppressed["count"]}
            [counters] = await client.get("plant/@gateway/demo/zenoh")
            assert counters.json["refusals_untold"] == suppressed["count"]
