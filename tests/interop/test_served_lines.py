"""Served lines beside masters nobody here wrote: libmodbus, mbpoll and pymodbus' client."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

from gateway.config import built
from gateway.parts.serving.served_line import ServedLine
from gateway.stations.served.registers import ServedTag
from gateway.stations.served.station import ServedStation
from gateway.tags import Sample, good
from tests.conftest import needs
from tests.interop.peers import finished, pty_pair
from tests.zenoh_peer import free_port

TAGS = {
    "seen": {"address": "holding:10", "type": "int32", "write": True},
    "order": {"address": "holding:100"},
    "ramp": {"address": "holding:110", "type": "float32", "word_order": "high_first"},
    "start": {"address": "coil:16"},
}
ACCEPT = ["holding:100..holding:163", "coil:16..coil:36"]


class Plant:
    """Keeps what the master wrote."""

    def __init__(self) -> None:
        self.given: list[Sample] = []

    def samples(self, samples: Sequence[Sample]) -> None:
        self.given += samples

    def online(self, device: ServedStation, online: bool) -> None: ...

    def written(self, name: str) -> list[object]:
        return [sample.value for sample in self.given if sample.tag.name == name]


@asynccontextmanager
async def serving(port: str, protocol: str) -> AsyncIterator[Plant]:
    """Serves station 1 on the port; `seen` is 70000."""
    device = {"protocol": protocol, "station": 1, "accept": ACCEPT, "tags": TAGS}
    served = {"port": port, "serve": True, "devices": {"hmi": device}}
    if not port.startswith("tcp"):
        served |= {"baudrate": 19200, "format": "8N1"}
    [config] = built({"lines": {"panel": served}}).lines
    plant = Plant()

    def sample_of(row: ServedTag) -> Sample:
        return good(row.tag, 70000, 0)

    line = ServedLine(config, plant, sample_of)
    task = asyncio.create_task(line.run())
    try:
        async with asyncio.timeout(300):
            while not line.is_open:
                await asyncio.sleep(0)
        yield plant
    finally:
        task.cancel()
        await asyncio.wait([task])
    assert line.stale == 0


async def test_libmodbus_asks_a_served_station_over_tcp(libmodbus: Path) -> None:
    number = free_port()
    async with serving(f"tcp://127.0.0.1:{number}", "modbus-tcp") as plant:
        await finished(libmodbus / "modbus_master", "tcp", str(number), "1")
    assert plant.written("order") == [300]
    assert plant.written("start") == [True]


async def test_libmodbus_asks_a_served_station_on_a_pty(
    libmodbus: Path, socat: str, tmp_path: Path
) -> None:
    async with pty_pair(tmp_path) as (ours, theirs), serving(str(ours), "modbus-rtu") as plant:
        await finished(libmodbus / "modbus_master", "rtu", theirs, "1")
    assert plant.written("order") == [300]
    assert plant.written("start") == [True]


async def test_mbpoll_asks_served_stations(socat: str, tmp_path: Path) -> None:
    mbpoll, number = needs("mbpoll"), free_port()
    tcp = (mbpoll, "-m", "tcp", "-p", str(number), "-0", "-1", "-a", "1")
    async with serving(f"tcp://127.0.0.1:{number}", "modbus-tcp") as plant:
        out = await finished(*tcp, "-t", "4:int", "-r", "10", "127.0.0.1")
        assert "[10]: \t70000" in out
        await finished(*tcp, "-t", "4:float", "-B", "-r", "110", "127.0.0.1", "1.5")
    assert plant.written("ramp") == [1.5]
    async with pty_pair(tmp_path) as (ours, theirs), serving(str(ours), "modbus-rtu") as plant:
        rtu = (mbpoll, "-m", "rtu", "-b", "19200", "-P", "none", "-0", "-1", "-a", "1")
        out = await finished(*rtu, "-t", "4:int", "-r", "10", theirs)
        assert "[10]: \t70000" in out
        await finished(*rtu, "-t", "4", "-r", "100", theirs, "7", "8")
    assert plant.written("order") == [7]


@pytest.mark.parametrize("protocol", ["modbus-tcp", "modbus-rtu", "modbus-ascii"])
async def test_the_client_of_pymodbus_asks_served_stations(
    protocol: str, socat: str, tmp_path: Path
) -> None:
    number = free_port()
    async with pty_pair(tmp_path) as (ours, theirs):
        client: AsyncModbusTcpClient | AsyncModbusSerialClient
        if protocol == "modbus-tcp":
            where = f"tcp://127.0.0.1:{number}"
            client = AsyncModbusTcpClient("127.0.0.1", port=number)
        else:
            where, framer = str(ours), FramerType(protocol.removeprefix("modbus-"))
            client = AsyncModbusSerialClient(str(theirs), framer=framer, baudrate=19200)
        async with serving(where, protocol) as plant:
            assert await client.connect()
            try:
                read = await client.read_holding_registers(10, count=2, device_id=1)
                assert read.registers == [70000 & 0xFFFF, 1]
                for value in (1, 2, 2):
                    done = await client.write_register(100, value, device_id=1)
                    assert not done.isError()
                await client.write_coils(16, [True] * 21, device_id=1)
                refused = await client.write_registers(163, [1, 2], device_id=1)
                assert refused.exception_code == 2
                await client.write_registers(110, [0x3FC0, 0], device_id=1)
            finally:
                client.close()
    assert plant.written("order") == [1, 2, 2]
    assert plant.written("start") == [True]
    assert plant.written("ramp") == [1.5]
