"""A client asks thousands of questions and receives no answer: the gateway serves all others."""

import asyncio
import subprocess
import sys
from pathlib import Path

from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

DEAF = Path(__file__).with_name("deaf_client.py")
PATIENCE = 300.0  # seconds; about 10 on an idle machine
TAGS, WIDE, NARROW = 2000, 60, 2000  # together more than the system takes for a link


async def is_over(client: ZenohPeer) -> bool:
    """The gateway has closed the link of the deaf client, and did not start over: it has all
    queries."""
    replies = await client.get("plant/@gateway/demo/zenoh", timeout=1.0)
    found = [reply.json for reply in replies if reply.ok]  # none while it is busy
    return any(one["queries"] > NARROW and one["links"] == 1 for one in found)


async def test_a_client_that_receives_nothing_does_not_stop_the_gateway(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    tags = {f"t{n}": {"address": f"holding:{n}", "every": "1s"} for n in range(TAGS)}
    device = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
    line = {"port": "simulator", "devices": {"plc": device}}
    file = write_config(tmp_path / "c.yaml", endpoint, {"hall": line})
    with await asyncio.to_thread(started, file):
        async with ZenohPeer("client", connect=[endpoint]) as client:
            deaf = subprocess.Popen([sys.executable, DEAF, endpoint, str(WIDE), str(NARROW)])
            try:
                async with asyncio.timeout(PATIENCE):
                    while not await is_over(client):
                        await asyncio.sleep(0.1)
            finally:
                deaf.kill()
                deaf.wait()


async def test_several_threads_send_so_that_one_link_holds_up_no_other(tmp_path: Path) -> None:
    endpoint, line = free_endpoint(), vigor_line("simulator", {"level": {"address": "D10"}})
    file = write_config(tmp_path / "c.yaml", endpoint, {"hall": line})
    with await asyncio.to_thread(started, file) as gateway:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            assert await client.get("plant/**")  # a link: Zenoh starts these threads with the first
            threads = Path(f"/proc/{gateway.pid}/task").glob("*/comm")
            names = {path.read_text().strip() for path in threads}
            assert {"tx-0", "tx-1", "tx-2", "tx-3"} <= names
