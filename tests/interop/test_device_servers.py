"""Device servers that connect to the gateway, with pymodbus's server behind each of them."""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from tests.e2e.processes import PATIENCE, Program, plc_gateway, started, write_config
from tests.interop.peers import HERE, running
from tests.zenoh_peer import free_endpoint, free_port


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(ConnectionError):
        while data := await reader.read(1000):
            writer.write(data)


@asynccontextmanager
async def device_server(
    gateway: int, registration: bytes, slave: int | None
) -> AsyncIterator[asyncio.StreamWriter]:
    """Connects, registers, and passes bytes to and from the slave; without one it is mute, like one
    whose connection is gone and not closed. Yields what sends heartbeats."""
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", gateway)
                break
            except ConnectionRefusedError:  # the gateway starts
                await asyncio.sleep(0)
    writer.write(registration + b"ping")
    ends, pumps = [writer], list[asyncio.Task[None]]()
    if slave is not None:
        answers, asks = await asyncio.open_connection("127.0.0.1", slave)
        ends.append(asks)
        pumps = [asyncio.create_task(_pump(*pair)) for pair in ((reader, asks), (answers, writer))]
    try:
        yield writer
    finally:
        for end in ends:
            end.transport.abort()
        await asyncio.gather(*pumps)


async def says(gateway: Program, *words: str) -> None:
    await asyncio.to_thread(gateway.says, *words)


async def test_two_sites_call_in_at_one_port_and_come_back_after_every_loss(
    tmp_path: Path,
) -> None:
    port, slave = free_port(), free_port()
    lines = {
        site: {
            "port": f"listen://127.0.0.1:{port}",
            "device_server": {"registration": f"{site}<CR>", "heartbeat": "ping"},
            "devices": {
                f"pump-{site}": {
                    "protocol": "modbus-rtu",
                    "station": 1,
                    "defaults": {"every": "100ms"},
                    "tags": {"level": {"address": f"holding:{register}", "write": True}},
                }
            },
        }
        for site, register in (("north", 7), ("south", 9))
    }
    file = write_config(tmp_path / "plant.yaml", free_endpoint(), lines)
    server = (sys.executable, HERE / "pymodbus_server.py", "rtu", "tcp", str(slave))

    def read(tag: str) -> object:
        return plc_gateway("read", file, tag, "--json").json["value"]

    async with running(*server, ready=b"ready"):
        with await asyncio.to_thread(started, file) as gateway:
            async with (
                device_server(port, b"north\r", slave) as north,
                device_server(port, b"south\r", slave),
            ):
                for site in ("north", "south"):
                    await says(gateway, "device online", f"pump-{site}")
                north.write(b"ping")
                assert await asyncio.to_thread(read, "pump-north/level") == 7
                assert await asyncio.to_thread(read, "pump-south/level") == 9
                done = await asyncio.to_thread(plc_gateway, "write", file, "pump-south/level", 4321)
                assert done.code == 0, done
                assert await asyncio.to_thread(read, "pump-south/level") == 4321
            await says(gateway, "line down", "line=north", "closed by the other side")
            lost = len(gateway.lines)
            # One that lost its power: the gateway's end of its connection knows nothing.
            async with (
                device_server(port, b"north\r", None),
                device_server(port, b"north\r", slave),
            ):
                await says(gateway, "line down", "line=north", "has connected again")
                await asyncio.to_thread(gateway.says, "device online", "pump-north", after=lost)
                assert await asyncio.to_thread(read, "pump-north/level") == 7
            async with device_server(port, b"nobody", None):
                await says(gateway, "connection refused", "sent=nobodyping")
