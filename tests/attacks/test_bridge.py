"""A Modbus TCP bridge that asks one serial unit at a time, with a time-out of its own.

Unit 2 is dead. While the bridge waits for it, requests to unit 1 wait in the bridge.
"""

import asyncio
from pathlib import Path

import pytest

from tests.e2e.processes import started, write_config
from tests.northbound.plant import until
from tests.zenoh_peer import ZenohPeer, free_endpoint

WAIT = 0.9  # seconds that the bridge waits for a unit


class Bridge:
    """`says_so`: answers for the dead unit with exception 0B; otherwise it stays silent."""

    def __init__(self, says_so: bool) -> None:
        self.says_so = says_so
        self.given_up = 0
        self.closed = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        requests: asyncio.Queue[bytes] = asyncio.Queue()
        task = asyncio.create_task(self._answer(requests, writer))
        try:
            while True:
                head = await reader.readexactly(6)
                requests.put_nowait(head + await reader.readexactly(head[5]))
        except asyncio.IncompleteReadError:
            writer.close()
        finally:
            task.cancel()
            self.closed.set()

    async def _answer(self, requests: "asyncio.Queue[bytes]", writer: asyncio.StreamWriter) -> None:
        while True:
            request = await requests.get()
            number, unit, function = request[:4], request[6:7], request[7]
            if unit != b"\x02":
                count = int.from_bytes(request[10:12], "big")
                pdu = bytes((function, 2 * count)) + bytes(2 * count)
                await asyncio.sleep(0.01)
            else:
                await asyncio.sleep(WAIT)
                self.given_up += 1
                pdu = bytes((function | 0x80, 0x0B))
                if not self.says_so:
                    continue
            writer.write(number + (len(pdu) + 1).to_bytes(2, "big") + unit + pdu)


@pytest.mark.parametrize("says_so", [True, False], ids=["0B", "silence"])
async def test_a_dead_unit_behind_a_bridge_leaves_the_other_good(
    tmp_path: Path, says_so: bool
) -> None:
    bridge, endpoint = Bridge(says_so), free_endpoint()
    server = await asyncio.start_server(bridge.serve, "127.0.0.1", 0)
    number = server.sockets[0].getsockname()[1]
    devices = {
        name: {
            "protocol": "modbus-tcp",
            "station": unit,
            "reply_timeout": "250ms",
            "tags": {"level": {"address": "holding:1"}},
        }
        for unit, name in enumerate(("alive", "dead"), 1)
    }
    line = {"port": f"tcp://127.0.0.1:{number}", "devices": devices}
    config = write_config(
        tmp_path / "config.yaml", endpoint, {"net": line}, defaults={"every": "500ms"}
    )
    async with server:
        with await asyncio.to_thread(started, config) as gateway:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/alive/level", advanced=True)
                await heard.next(lambda s: s.json["quality"] == "good")
                await until(lambda: bridge.given_up >= 3)
                await client.get("plant/alive/level?max_age=0s")
        await bridge.closed.wait()
    bad = [sample.json for sample in heard.samples if sample.json["quality"] == "bad"]
    assert [each for each in bad if each["reason"] != "starting"] == []
    assert not gateway.has_said("transaction failed", "device=alive")
