"""A gateway killed at any moment: what it acknowledged is kept, and its audit is whole."""

import asyncio
import os
import random
import signal
import time
from pathlib import Path

from gateway.parts.audit.file import checked, read
from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

RESTARTS = int(os.environ.get("RESTARTS", "4"))
ALARM = "plant/@gateway/demo/alarms/mixer"


async def test_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    """One alarm more is acknowledged in each round; then the gateway is killed."""
    endpoint, chance = free_endpoint(), random.Random(RESTARTS)
    alarms = {f"t{n}": {"address": f"D{n}", "alarm": {"low": 30_000}} for n in range(RESTARTS)}
    tags = {**alarms, "speed": {"address": "D7000", "write": True, "history": True}}
    file = write_config(
        tmp_path / "plant.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags)},
        gateway={"name": "demo", "audit": "audit.jsonl"},
        alarms={"path": "alarms.json"},
        history={"path": "history.db"},
    )
    acknowledged, sent = set[str](), list[int]()
    for number in range(RESTARTS):
        with await asyncio.to_thread(started, file) as gateway:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                await client.get_until(f"{ALARM}/t{number}", lambda one: one["state"] == "active")
                for key in acknowledged:
                    [kept] = await client.get(f"{ALARM}/{key}")
                    assert kept.json["state"] == "acknowledged"
                    assert kept.json["acknowledged"]["by"] == "Ana"
                for _ in range(3):
                    sent.append(len(sent))
                    [done] = await client.get("plant/mixer/speed/@set", b"%d" % sent[-1])
                    assert done.ok
                [answer] = await client.get(f"{ALARM}/t{number}", b'{"by": "Ana"}')
                assert answer.json["state"] == "acknowledged"
                acknowledged.add(f"t{number}")
                time.sleep(chance.uniform(0, 0.1))  # the kill comes at any moment
                gateway.end(signal.SIGKILL)
            assert not gateway.has_said("history failed")
            assert not gateway.has_said("Traceback")
    records = [*checked(read(tmp_path / "audit.jsonl"))]
    assert [record.why for record in records if record.why] == []
    found = [one.event["value"] for one in records if one.event.get("outcome") == "written"]
    assert found == sorted(set(found) & set(sent))
