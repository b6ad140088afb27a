"""A recipe of fifty words, a word that the PLC lacks, and the bit that starts the machine."""

import asyncio
import json
from pathlib import Path

from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.simulator.serve import serve_on_tcp
from gateway.stations.vigor import VigorStation
from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint, free_port

WIRE = WireTiming(115_200, character_bits("7E1"))
RECIPE = {f"w{n}": n * 3 for n in range(50)}


class Counting(VigorStation):
    """Keeps the requests that write."""

    def __init__(self) -> None:
        super().__init__(1)
        self.writes: list[bytes] = []
        self.memory.holes = {("D", 520)}

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if data[3:5] in (b"61", b"70", b"71"):
            self.writes.append(data[3:9])
        return super().hear(data, now)


async def test_the_recipe_is_one_exchange_and_the_machine_never_starts_after_a_fault(
    tmp_path: Path,
) -> None:
    plc, endpoint, number = Counting(), free_endpoint(), free_port()
    served = await serve_on_tcp([plc], WIRE, "127.0.0.1", number)
    addresses = {f"w{n}": f"D{100 + n}" for n in range(50)} | {"missing": "D520", "go": "M0"}
    tags = {
        name: {"address": address, "write": True, "every": "60s"}
        for name, address in addresses.items()
    }
    line = vigor_line(f"tcp://127.0.0.1:{number}", tags, retries=2)
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
    with await asyncio.to_thread(started, config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            told = await client.subscribe("plant/@gateway/demo/writes")
            [wrong] = await client.get("plant/mixer/@set", json.dumps({**RECIPE, "x": 1}).encode())
            assert plc.writes == []
            group = {**RECIPE, "missing": 1, "go": True}
            [reply] = await client.get("plant/mixer/@set", json.dumps(group).encode())
            sent = [*plc.writes]
            await client.put("plant/mixer/@set", b'{"w1": 77, "w0": 78, "go": true}')
            await told.until(lambda h: len(h.samples) == 51 + 52 + 3)
    await served.close()
    assert wrong.json["error"] == "unknown-tag"
    assert {end.get("error") for end in wrong.json["tags"].values()} == {"unknown-tag", "not-sent"}
    assert not reply.ok
    ends = reply.json["tags"]
    assert (reply.json["error"], ends["missing"]["error"]) == ("incomplete", "refused")
    assert ends["go"]["reason"] == "not sent, because missing before it failed"
    assert {name: ends[name].get("value") for name in RECIPE} == RECIPE
    # D100 to D149 with one request, D520 with another.
    assert sent == [b"611CC8", b"612010"]
    assert plc.writes[2:] == [b"611CC8", b"700400"]
    assert plc.memory.read("D", 100, 3) == [78, 77, 6]
    assert plc.memory.read("M", 0) == [1]
