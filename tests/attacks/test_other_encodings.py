"""Bytes in another encoding are not read as JSON: CBOR's -22 is the byte of JSON's 5."""

import asyncio
from pathlib import Path

import pytest

from tests.attacks.security_pages import plant_file
from tests.e2e.processes import free_port, started
from tests.zenoh_peer import ZenohPeer

RECIPE = "plant/mixer/recipe/@set"
OTHERS = ["application/cbor", "zenoh/serialized", "zenoh/int8", "application/octet-stream", "x/y;z"]
TEXTS = ["zenoh/bytes", "zenoh/string", "text/plain", "text/json", "application/json;v=1"]
REQUESTS = {
    RECIPE: b"5",
    "plant/mixer/@set": b'{"recipe": 5}',
    "plant/oven/@loopback": b"AB",
    "plant/mixer/@peek": b"D10",
    "plant/@gateway/demo/alarms/mixer": b'{"by": "anna"}',
}


@pytest.mark.parametrize("encoding", OTHERS)
async def test_another_encoding_is_refused_with_its_name(encoding: str, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    text = "zenoh: {listen: [tcp/127.0.0.1:7447]}\n"
    path = plant_file(tmp_path, text, port, control=True)
    with await asyncio.to_thread(started, path) as program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            await asyncio.to_thread(program.says, "device online")
            outcomes = await client.subscribe("plant/@gateway/demo/writes")
            for key, data in REQUESTS.items():
                [reply] = await client.get(key, data, encoding=encoding)
                assert reply.json["error"] in ("bad-value", "bad-query"), key
                assert repr(encoding) in reply.json["reason"], key
            await client.put(RECIPE, b"5", encoding=encoding)
            await outcomes.until(lambda of: len(of.samples) == 5)
            assert {sample.json["outcome"] for sample in outcomes.samples} == {"bad-value"}
            for known in TEXTS:
                [reply] = await client.get(RECIPE, b"7", encoding=known)
                assert reply.ok, known
