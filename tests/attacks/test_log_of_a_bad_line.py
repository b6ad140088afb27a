"""A device that garbles every fifth reply for hours must not fill the disk with log entries."""

import asyncio
from pathlib import Path

from gateway.cli.line.repeats import BURST
from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint


async def test_a_bad_line_is_logged_now_and_then(tmp_path: Path) -> None:
    async def garbles(
        _number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            for _ in range(4):
                writer.write(tcp_reply(await reader.readexactly(12)))
            request = bytearray(await reader.readexactly(12))
            request[7] ^= 0x7F  # another function
            writer.write(tcp_reply(bytes(request)))

    endpoint = free_endpoint()
    async with peer(garbles) as port:
        device = {
            "protocol": "modbus-tcp",
            "station": 1,
            "reply_timeout": "20ms",
            "late_guard": "0s",
            "tags": {f"t{n}": {"address": f"holding:{1000 * n}"} for n in range(6)},
        }
        line = {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}
        file = write_config(
            tmp_path / "c.yaml", endpoint, {"net": line}, defaults={"every": "20ms"}
        )
        with await asyncio.to_thread(started, file) as program:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                await client.get_until(
                    "plant/@gateway/demo/devices/plc",
                    lambda status: sum(status["failures"].values()) > 2 * BURST,
                )
            failed = [line for line in program.lines if "transaction failed" in line]
            assert 1 <= len(failed) <= BURST + 2
