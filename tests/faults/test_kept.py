"""A gateway killed at any moment: what it acknowledged is kept, and its audit is whole.

Kept are alarms and acknowledgements, the audit, the history, what was claimed, the nonces of signed
writes, and the totals of counters. The PLC is a process of its own and is never killed.
"""

import asyncio
import os
import random
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import orjson

from gateway.parts.audit.file import checked, read
from tests.attacks.test_security_writers import Writer
from tests.e2e.processes import (
    Program,
    free_port,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

RESTARTS = int(os.environ.get("RESTARTS", "4"))
ALARM, SPEED = "plant/@gateway/demo/alarms/mixer", "plant/mixer/speed/@set"
PARTS = "plant/mixer/parts"
ALICE = "alice:" + "a" * 40
TOP = 9  # of the counter: it begins again at 0 in each third round
# The command itself; it only saves the totals of counters more often.
RUN = """
import gateway.parts.state.part as part
part.SAVE_EVERY = 0.1
from gateway.cli.main import main
main()
"""


def has(name: str, value: object, document: Any) -> bool:
    return bool(document[name] == value)


def is_saved(path: Path, total: int) -> bool:
    try:
        return bool(orjson.loads(path.read_bytes())["counters"]["mixer/parts D7001"][1] == total)
    except (FileNotFoundError, KeyError):
        return False


async def test_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    """One alarm more is acknowledged in each round; then the gateway is killed."""
    endpoint, beside, port = free_endpoint(), free_endpoint(), free_port()
    chance = random.Random(RESTARTS)
    secret(tmp_path / "writers.txt", ALICE + "\n")
    secret(tmp_path / "plant.txt", "a secret of twenty or more\n")
    alarms = {f"t{n}": {"address": f"D{n}", "alarm": {"low": 30_000}} for n in range(RESTARTS)}
    tags: dict[str, Any] = {
        **alarms,
        "speed": {"address": "D7000", "write": True, "history": True},
        "parts": {"address": "D7001", "counter": {"top": TOP}},
    }
    own = {"secret_file": "plant.txt"}
    file = write_config(
        tmp_path / "plant.yaml",
        endpoint,
        {"hall": vigor_line(f"tcp://127.0.0.1:{port}", tags, reply_timeout="2s")},
        gateway={**own, "name": "demo", "audit": "audit.jsonl", "state": "state.json"},
        alarms={"path": "alarms.json"},
        history={"path": "history.db"},
        writers={"file": "writers.txt"},
    )
    other = write_config(
        tmp_path / "other.yaml",
        "",
        {"annex": {"port": "simulator", "devices": {"press": {"protocol": "vigor", "station": 1}}}},
        gateway={**own, "name": "other"},
        zenoh={"prefix": "plant", "listen": [beside], "connect": [endpoint]},
    )
    state = tmp_path / "state.json"
    acknowledged, sent, stolen = set[str](), list[int](), list[bytes]()
    with station("tcp", str(port)) as plc, started(other) as neighbour:
        for number in range(RESTARTS):
            with Program(sys.executable, "-c", RUN, "run", file) as gateway:
                await asyncio.to_thread(gateway.says, "Zenoh session ready")
                async with ZenohPeer("client", connect=[endpoint]) as client:
                    alice, alarm = Writer(client, ALICE), f"{ALARM}/t{number}"
                    for attachment in stolen:
                        [again] = await client.get(SPEED, b"%d" % sent[-1], attachment=attachment)
                        assert again.json["error"] in ("not-allowed", "unclear")
                    await client.get_until(alarm, partial(has, "state", "active"))
                    for key in acknowledged:
                        [kept] = await client.get(f"{ALARM}/{key}")
                        assert kept.json["state"] == "acknowledged"
                        assert kept.json["acknowledged"]["by"] == "Ana"
                    # The total goes on from the one on disk, through the counter's return to 0.
                    for total in range(4 * number + 1, 4 * number + 5):
                        plc.tell(f"set 1 D 7001 {total % (TOP + 1)}")
                        await client.get_until(PARTS, partial(has, "value", total))
                    while len(sent) < 3 * (number + 1):
                        value = b"%d" % (len(sent) + 1)
                        attachment = alice.signed(value, SPEED)
                        if await alice.says(value, attachment, SPEED) == "ok":
                            sent.append(int(value))
                            stolen = [attachment]
                    by = b'{"by": "Ana"}'
                    [answer] = await client.get(alarm, by, attachment=alice.signed(by, alarm))
                    assert answer.json["state"] == "acknowledged"
                    acknowledged.add(f"t{number}")
                    await asyncio.to_thread(until, partial(is_saved, state, total), "it is saved")
                    [status] = await client.get("plant/@gateway/demo/status")
                    assert status.json["refused_devices"] == {}
                    time.sleep(chance.uniform(0, 0.1))  # the kill comes at any moment
                    gateway.end(signal.SIGKILL)
            assert not gateway.has_said("history failed")
            assert not gateway.has_said("Traceback")
        assert not neighbour.has_said("Traceback")
        assert not neighbour.has_said("claim refused")
        assert plc.tell("get 1 D 7000") == str(sent[-1])
    records = [*checked(read(tmp_path / "audit.jsonl"))]
    assert [record.why for record in records if record.why] == []
    found = [one.event["value"] for one in records if one.event.get("outcome") == "written"]
    assert found == sorted(set(found) & set(sent))
