"""TCP connections to the Zenoh port that send nothing must not keep new clients out."""

import asyncio
import socket
from contextlib import ExitStack
from pathlib import Path

from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

SILENT = 300


async def test_a_client_connects_beside_connections_that_send_nothing(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    port = int(endpoint.rpartition(":")[2])
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    file = write_config(tmp_path / "c.yaml", endpoint, lines)
    with await asyncio.to_thread(started, file), ExitStack() as connections:
        for _ in range(SILENT):
            silent = socket.create_connection(("127.0.0.1", port))
            connections.enter_context(silent)
        async with ZenohPeer("client", connect=[endpoint]) as client:
            [reply] = await client.get("plant/mixer/speed")
            assert reply.ok
