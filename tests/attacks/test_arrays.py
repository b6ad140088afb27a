"""Arrays at the real program, beside a Modbus server that nobody here wrote."""

import sys
from pathlib import Path

from tests.e2e.processes import started, write_config
from tests.interop.peers import HERE, running
from tests.zenoh_peer import ZenohPeer, free_endpoint, free_port

WRITE = {"max": 60000, "verify": True}
TAGS = {
    "recipe": {
        "address": "holding:100",
        "type": "uint16[50]",
        "write": WRITE,
        "history": True,
        "deadband": 2,
    },
    "third": {"address": "holding:103"},
    "valves": {"address": "coil:10", "type": "bool[30]", "write": True},
    "curve": {"address": "holding:300", "type": "float32[8]", "write": True, "payload": "raw"},
}


async def test_an_array_is_read_published_and_written_as_one_value(tmp_path: Path) -> None:
    endpoint, port = free_endpoint(), free_port()
    plc = {"protocol": "modbus-tcp", "station": 1, "tags": TAGS}
    line = {"port": f"tcp://127.0.0.1:{port}", "devices": {"mixer": plc}}
    history = {"path": "history.db"}
    config = write_config(tmp_path / "c.yaml", endpoint, {"hall": line}, history=history)
    server = (sys.executable, HERE / "pymodbus_server.py", "socket", "tcp", str(port))
    async with running(*server, ready=b"ready"):
        with started(config) as program:
            await _there_and_back(endpoint)
            assert program.end() == 0


async def _there_and_back(endpoint: str) -> None:
    async with ZenohPeer("client", connect=[endpoint]) as client:
        [reply] = await client.get("plant/mixer/recipe?max_age=0s")
        assert reply.json["value"] == list(range(100, 150))
        [reply] = await client.get("plant/mixer/valves?max_age=0s")
        assert reply.json["value"] == [number % 3 == 0 for number in range(10, 40)]
        [meta] = await client.get("plant/mixer/recipe/@meta")
        assert (meta.json["type"], meta.json["length"]) == ("uint16[50]", 50)

        values = await client.subscribe("plant/mixer/recipe")
        new = [7, *range(101, 149), 60000]
        [written] = await client.get("plant/mixer/recipe/@set", str(new).encode())
        assert (written.json["value"], written.json["verified"]) == (new, True)
        seen = await values.next(lambda sample: sample.json["value"] == new)
        assert seen.json["quality"] == "good"
        one_less = [7, 102, *new[2:]]  # less than the deadband
        [written] = await client.get("plant/mixer/recipe/@set", str(one_less).encode())
        assert written.json["value"] == one_less
        [refused] = await client.get("plant/mixer/recipe/@set", str([*new[:-1], 60001]).encode())
        assert refused.json["error"] == "bad-value"
        assert refused.json["reason"] == "element 49: 60001 is above the greatest value 60000"
        [refused] = await client.get("plant/mixer/recipe/@set", b"[1, 2]")
        assert refused.json["reason"] == "a list of 2 is written to uint16[50]: send 50"
        [refused] = await client.get("plant/mixer/third/@set", b"[1]")
        assert refused.json["error"] == "not-writable"
        [third] = await client.get("plant/mixer/third?max_age=0s")
        assert third.json["value"] == 103

        valves = "[" + ", ".join(["true", "false"] * 15) + "]"
        [written] = await client.get("plant/mixer/valves/@set", valves.encode())
        assert written.json["value"] == [True, False] * 15
        curve = await client.subscribe("plant/mixer/curve")
        [written] = await client.get("plant/mixer/curve/@set", b"[0.1,2,3,4,5,6,7,-8.5]")
        assert written.json["value"] == [0.1, 2, 3, 4, 5, 6, 7, -8.5]
        await curve.next(lambda sample: sample.payload == b"[0.1,2.0,3.0,4.0,5.0,6.0,7.0,-8.5]")

        past = await client.get("plant/mixer/recipe?_time=[now(-1m)..]")
        good = [sample.json["value"] for sample in past if sample.json["quality"] == "good"]
        # All values are put again some time after the link of a client, also within the deadband.
        assert good in ([list(range(100, 150)), new], [list(range(100, 150)), new, one_less])
        buckets = await client.get("plant/mixer/recipe?_time=[now(-1m)..];bucket=1h")
        assert sum(bucket.json["good"] for bucket in buckets) == len(good)
        assert {bucket.json["mean"] for bucket in buckets} == {None}
        assert buckets[-1].json["last"] == good[-1]
