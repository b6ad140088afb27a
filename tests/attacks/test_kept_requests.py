"""A gateway starts at a device server that has kept requests of the gateway before."""

import asyncio
import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from gateway.protocols.checksums import crc16
from gateway.stations.modbus import ModbusStation
from tests.e2e.processes import free_port, started
from tests.zenoh_peer import ZenohPeer, free_endpoint

NUMBERS = (100, 200, 300)
REQUEST = 8  # bytes of a read by Modbus RTU


def read_of(number: int, words: int) -> bytes:
    body = bytes((1, 3, *number.to_bytes(2, "big"), 0, words))
    return body + crc16(body)


class Keeps:
    """Modbus RTU over TCP, which has kept reads of a process that was killed."""

    def __init__(self) -> None:
        self._station = ModbusStation(station=1, framing="rtu")
        for number in NUMBERS:
            self._station.memory.write("holding", number, [number])
        self._kept = [read_of(300, 1), read_of(200, 2)]

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Passes on one request after the other, in their order."""
        requests: asyncio.Queue[bytes] = asyncio.Queue()
        for request in self._kept:
            requests.put_nowait(request)

        async def pass_on() -> None:
            await asked.wait()
            while True:
                for reply in self._station.hear(await requests.get(), 0.0):
                    await asyncio.sleep(0.02)  # the time of the wire
                    writer.write(reply)

        asked = asyncio.Event()
        passing = asyncio.create_task(pass_on())
        try:
            with suppress(ConnectionError, asyncio.IncompleteReadError):
                while True:
                    requests.put_nowait(await reader.readexactly(REQUEST))
                    asked.set()
        finally:
            passing.cancel()
            writer.close()


def plant(port: int, zenoh: str) -> str:
    tags = ", ".join(f"n{n}: {{address: 'holding:{n}', every: 10ms}}" for n in NUMBERS)
    return f"""
gateway: {{name: killed}}
zenoh: {{mode: client, listen: [], connect: ["{zenoh}"]}}
lines:
  hall:
    port: tcp://127.0.0.1:{port}
    baudrate: 115200
    devices:
      meter: {{protocol: modbus-rtu, station: 1, tags: {{{tags}}}}}
"""


async def test_a_gateway_takes_no_reply_to_the_one_before(tmp_path: Path) -> None:
    server, port, zenoh = Keeps(), free_port(), free_endpoint()
    config = tmp_path / "plant.yaml"
    config.write_text(plant(port, zenoh))
    listener = await asyncio.start_server(server.serve, "127.0.0.1", port)
    async with listener, ZenohPeer("router", listen=[zenoh]) as router:
        values = await router.subscribe("plant/meter/*")
        with await asyncio.to_thread(started, config) as program:
            await asyncio.to_thread(program.says, "device online")
            for number in NUMBERS:
                [reply] = await router.get(f"plant/meter/n{number}?max_age=0.01")
                assert reply.json["value"] == number
    good = {(s.key, s.json["value"]) for s in values.samples if s.json["quality"] == "good"}
    assert good == {(f"plant/meter/n{n}", n) for n in NUMBERS}


class Stalls:
    """Modbus RTU over TCP. Its link stalls, and later passes on all requests, in their order."""

    def __init__(self) -> None:
        self._station = ModbusStation(station=1, framing="rtu")
        for number, value in ((1000, 22), (2000, 33)):
            self._station.memory.write("holding", number, [value])
        self._requests: asyncio.Queue[bytes] = asyncio.Queue()
        self._writer: asyncio.StreamWriter | None = None
        self._passes = asyncio.Event()
        self._passes.set()
        self.stalls = asyncio.Event()
        self.renamed = asyncio.Event()
        self.kept = 0

    async def pass_on(self) -> None:
        while True:
            request = await self._requests.get()
            await self._passes.wait()
            for reply in self._station.hear(request, 0.0):
                await asyncio.sleep(0.002)  # the time of the wire
                if self._writer is not None:
                    self._writer.write(reply)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """A connection that is opened again gets the replies to the one before."""
        self._writer = writer
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                self._requests.put_nowait(await reader.readexactly(REQUEST))
                if self.renamed.is_set():
                    self._passes.set()
                elif self.stalls.is_set():
                    self._passes.clear()
                    self.kept += 1
        writer.close()


@pytest.mark.parametrize("again", [False, True])
async def test_a_renamed_device_takes_no_reply_to_the_one_before(
    tmp_path: Path, *, again: bool
) -> None:
    """`again`: the device is disabled first, and has another name when it is enabled."""

    def file(name: str, number: int, *, enabled: bool = True) -> None:
        device = f"protocol: modbus-rtu, station: 1, enabled: {str(enabled).lower()}"
        tags = f"n: {{address: 'holding:{number}', every: 50ms}}"
        other = "{protocol: modbus-rtu, station: 2, tags: {m: {address: 'holding:1', every: 10s}}}"
        config.write_text(f"""
gateway: {{name: renaming}}
zenoh: {{mode: client, listen: [], connect: ["{zenoh}"]}}
lines:
  hall:
    port: tcp://127.0.0.1:{port}
    baudrate: 115200
    devices:
      {name}: {{{device}, tags: {{{tags}}}}}
      other: {other}
""")

    server, port, zenoh = Stalls(), free_port(), free_endpoint()
    config = tmp_path / "plant.yaml"
    file("meter", 2000)
    listener = await asyncio.start_server(server.serve, "127.0.0.1", port)
    async with listener, ZenohPeer("router", listen=[zenoh]) as router:
        passing = asyncio.create_task(server.pass_on())
        values = await router.subscribe("plant/pump/*")
        with await asyncio.to_thread(started, config) as program:
            await asyncio.to_thread(program.says, "device online")
            server.stalls.set()
            await asyncio.to_thread(program.says, "device offline")
            if again:
                file("meter", 2000, enabled=False)
                os.kill(program.pid, signal.SIGHUP)
                await asyncio.to_thread(program.says, "file reloaded")
            assert server.kept > 1
            server.renamed.set()
            file("pump", 1000)
            os.kill(program.pid, signal.SIGHUP)
            await values.next(lambda sample: sample.json["quality"] == "good")
            await asyncio.sleep(1)  # late replies would arrive now
        passing.cancel()
    assert {s.json["value"] for s in values.samples if s.json["quality"] == "good"} == {22}
