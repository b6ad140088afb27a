"""A recording of a plant, served by one process, polled by another."""

import asyncio
from pathlib import Path

from tests.e2e.processes import PATIENCE, free_port, gateway, started, write_config
from tests.zenoh_peer import POLL, ZenohPeer, free_endpoint

# Three reads of holding:7 and holding:8 of station 1, as `trace --record` writes them.
LOG = """\
# line hall
# protocol modbus-rtu
# wire 9600 8E1
100.000000 > 01 03 00 07 00 02 75 ca
100.020000 < 01 03 04 00 11 00 22 2a 2f
100.020100 # meter: read holding:7..8, 20.1 ms
100.020100 = meter/a 17
"""
EXPECTED = {"plant/meter/a": 17, "plant/meter/b": 34, "plant/meter/c": "refused"}


async def values(client: ZenohPeer) -> dict[str, object]:
    """Returns the value of each tag, or why it has none."""
    replies = await client.get("plant/meter/*")
    assert {reply.json["origin"] for reply in replies} <= {"replayed"}
    return {str(reply.key): reply.json.get("reason", reply.json["value"]) for reply in replies}


async def test_a_gateway_on_a_served_recording_gets_the_recorded_values(tmp_path: Path) -> None:
    log, endpoint, port = tmp_path / "hall.log", free_endpoint(), free_port()
    log.write_text(LOG)
    tags = {
        "a": {"address": "holding:7"},
        "b": {"address": "holding:8"},
        "c": {"address": "holding:9"},
    }
    device = {"protocol": "modbus-rtu", "station": 1, "tags": tags}
    line = {"port": f"tcp://127.0.0.1:{port}", "baudrate": 9600, "devices": {"meter": device}}
    line["origin"] = "replayed"
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
    with gateway("replay", log, "--serve", "--tcp", f"127.0.0.1:{port}") as plant:
        said = await asyncio.to_thread(plant.says, "Ctrl-C")
        assert said.startswith(f"at tcp://127.0.0.1:{port}; a line that reads it needs `origin: ")
        with await asyncio.to_thread(started, config) as reader:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                async with asyncio.timeout(PATIENCE):
                    while await values(client) != EXPECTED:
                        await asyncio.sleep(POLL)
            assert reader.end() == 0
        assert plant.end() == 0
        assert plant.has_said("station-1: station 1, 2 addresses, 2 values in 0 s")
        assert plant.has_said("for what the recording does not hold: station 1: holding:")
