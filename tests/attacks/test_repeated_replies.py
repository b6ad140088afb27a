"""A device server on TCP that repeats replies, before a running gateway."""

import asyncio
from contextlib import suppress
from pathlib import Path

from gateway.stations.modbus import ModbusStation
from tests.e2e.processes import PATIENCE, free_port, started
from tests.zenoh_peer import ZenohPeer, free_endpoint

NUMBERS = (100, 200, 300, 400, 500)


class Repeats:
    """Modbus RTU over TCP. From the 50th reply on it sends each 20th reply twice."""

    def __init__(self) -> None:
        self.station = ModbusStation(station=1, framing="rtu")
        for number in NUMBERS:
            self.station.memory.write("holding", number, [number])
        self.replies = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        now = asyncio.get_running_loop().time
        with suppress(ConnectionError, asyncio.CancelledError):
            while data := await reader.read(256):
                for reply in self.station.hear(data, now()):
                    self.replies += 1
                    writer.write(reply)
                    if self.replies > 50 and self.replies % 20 == 0:
                        if self.replies % 40:
                            await asyncio.sleep(0.003)  # the next request is on its way
                        writer.write(reply)
                await writer.drain()
        writer.close()


def plant(port: int, zenoh: str) -> str:
    tags = "\n".join(
        f"          n{n}: {{address: 'holding:{n}', every: 10ms, heartbeat: 100ms}}"
        for n in NUMBERS
    )
    return f"""
gateway: {{name: attacked}}
zenoh: {{listen: ["{zenoh}"]}}
lines:
  hall:
    port: tcp://127.0.0.1:{port}
    baudrate: 115200
    devices:
      meter:
        protocol: modbus-rtu
        station: 1
        silence: 1ms
        tags:
{tags}
"""


async def test_a_device_server_that_repeats_replies_moves_no_value(tmp_path: Path) -> None:
    server = Repeats()
    port, zenoh = free_port(), free_endpoint()
    config = tmp_path / "plant.yaml"
    config.write_text(plant(port, zenoh))
    listener = await asyncio.start_server(server.serve, "127.0.0.1", port)
    async with listener:
        program = await asyncio.to_thread(started, config)
        with program:
            async with ZenohPeer("client", connect=[zenoh]) as client:
                values = await client.subscribe("plant/**")
                await values.next(lambda _: server.replies >= 600, timeout=PATIENCE)
                good = [s for s in values.samples if s.json["quality"] == "good"]
                assert len(good) > 20
                held = {(s.key, s.json["value"]) for s in good}
                assert held == {(f"plant/meter/n{n}", n) for n in NUMBERS}
                [status] = await client.get("plant/@gateway/attacked/devices/meter")
                assert status.json["standing"] == "up"
                assert "Answers twice" in status.json["diagnosis"]
