"""The Modbus drivers and stations beside programs nobody here wrote.

Drivers ask pymodbus' server, a libmodbus slave and npm's modbus-serial; the simulated slave
is asked by libmodbus, mbpoll and modbus-serial.
"""

import asyncio
import json
import re
import sys
from pathlib import Path

import pytest

from gateway.errors import Refused
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.stations.modbus import ModbusStation
from tests.conftest import needs
from tests.e2e.processes import started, write_config
from tests.interop.modbus_wire import (
    PATIENCE,
    End,
    Turn,
    serial_end,
    station_on_pty,
    station_on_tcp,
    tcp_end,
)
from tests.interop.peers import HERE, finished, pty_pair, running
from tests.zenoh_peer import ZenohPeer, free_endpoint, free_port

NPM = pytest.mark.usefixtures("modbus_serial")
SOCAT = pytest.mark.usefixtures("socat")
MBPOLL = pytest.mark.usefixtures("mbpoll")
HOLE = [("holding", 9000, 65535)]


@pytest.fixture
def mbpoll() -> str:
    return needs("mbpoll")


async def read(end: End, driver: AnyDriver, area: str, start: int, size: int) -> list[int]:
    return list(await driver.read(Turn(end, driver), Span(area, start, size)))


async def write(end: End, driver: AnyDriver, area: str, start: int, units: list[int]) -> bool:
    return await driver.write(Turn(end, driver), Span(area, start, len(units)), units)


async def all_a_driver_does(end: End, driver: AnyDriver) -> None:
    """With a peer whose coils are every third on, holding n is n, input n is 1000 + n."""
    assert await read(end, driver, "holding", 100, 64) == list(range(100, 164))
    assert await read(end, driver, "holding", 0, 125) == list(range(125))
    assert await read(end, driver, "input", 5, 3) == [1005, 1006, 1007]
    thirds = [int(n % 3 == 0) for n in range(40)]
    assert await read(end, driver, "coil", 0, 37) == thirds[:37]
    assert await read(end, driver, "discrete", 2, 9) == thirds[2:11]
    assert await write(end, driver, "holding", 200, [0xBEEF]) is True
    assert await write(end, driver, "holding", 201, [1, 2, 65535]) is True
    assert await read(end, driver, "holding", 200, 5) == [0xBEEF, 1, 2, 65535, 204]
    assert await write(end, driver, "coil", 300, [0]) is True
    assert await write(end, driver, "coil", 301, [1, 1, 0, 1, 0, 0, 1, 1, 1]) is True
    assert await read(end, driver, "coil", 300, 10) == [0, 1, 1, 0, 1, 0, 0, 1, 1, 1]
    with pytest.raises(Refused) as refused:
        await read(end, driver, "holding", 20000, 2)
    assert refused.value.code == "02"
    for salt in range(3):
        await driver.resync(Turn(end, driver), Span("holding", 100, 64), salt)


# ---- our drivers ask -------------------------------------------------------------------


@SOCAT
@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
async def test_the_driver_talks_to_pymodbus_on_a_pty(kind: type, tmp_path: Path) -> None:
    framer = "rtu" if kind is ModbusRtu else "ascii"
    async with pty_pair(tmp_path) as (ours, theirs):
        server = (sys.executable, HERE / "pymodbus_server.py", framer, theirs)
        async with running(*server, ready=b"ready"), serial_end(ours) as end:
            await all_a_driver_does(end, kind(station=1))


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii, ModbusTcp])
async def test_the_driver_talks_to_pymodbus_over_tcp(kind: type) -> None:
    framer, port = {ModbusRtu: "rtu", ModbusAscii: "ascii", ModbusTcp: "socket"}[kind], free_port()
    server = (sys.executable, HERE / "pymodbus_server.py", framer, "tcp", str(port))
    async with running(*server, ready=b"ready"), tcp_end(port) as end:
        await all_a_driver_does(end, kind(station=1))


@SOCAT
async def test_the_driver_talks_to_libmodbus_on_a_pty(libmodbus: Path, tmp_path: Path) -> None:
    async with pty_pair(tmp_path) as (ours, theirs):
        slave = (libmodbus / "modbus_slave", "rtu", theirs, "1")
        async with running(*slave, ready=b"ready"), serial_end(ours) as end:
            driver, everybody = ModbusRtu(station=1), ModbusRtu(station=0)
            await all_a_driver_does(end, driver)
            assert await write(end, everybody, "holding", 400, [7, 8]) is False
            assert await read(end, driver, "holding", 400, 2) == [7, 8]


async def test_the_driver_talks_to_libmodbus_over_tcp(libmodbus: Path) -> None:
    port = free_port()
    slave = (libmodbus / "modbus_slave", "tcp", str(port))
    async with running(*slave, ready=b"ready"), tcp_end(port) as end:
        await all_a_driver_does(end, ModbusTcp())


async def test_eight_requests_are_open_at_once_with_libmodbus(libmodbus: Path) -> None:
    port, driver = free_port(), ModbusTcp(window=8)
    slave = (libmodbus / "modbus_slave", "tcp", str(port))
    async with running(*slave, ready=b"ready"), tcp_end(port) as end:
        for _ in range(50):
            turn = Turn(end, driver)
            spans = [Span("holding", 10 * n, 10) for n in range(8)]
            values = await asyncio.gather(*(driver.read(turn, span) for span in spans))
            assert [unit for units in values for unit in units] == list(range(80))


@NPM
@SOCAT
async def test_the_driver_talks_to_modbus_serial_on_a_pty(tmp_path: Path) -> None:
    async with pty_pair(tmp_path) as (ours, theirs):
        server = ("node", "modbus_serial_server.js", "rtu", theirs)
        async with running(*server, ready=b"ready"), serial_end(ours) as end:
            await all_a_driver_does(end, ModbusRtu(station=1))


@NPM
async def test_the_driver_talks_to_modbus_serial_over_tcp() -> None:
    port = free_port()
    server = ("node", "modbus_serial_server.js", "tcp", str(port))
    async with running(*server, ready=b"ready"), tcp_end(port) as end:
        await all_a_driver_does(end, ModbusTcp())


# ---- our station is asked --------------------------------------------------------------


@SOCAT
async def test_libmodbus_talks_to_the_station_on_a_pty(libmodbus: Path, tmp_path: Path) -> None:
    station = ModbusStation(station=9, holes=HOLE)
    async with pty_pair(tmp_path) as (ours, theirs), station_on_pty(ours, station):
        await finished(libmodbus / "modbus_master", "rtu", theirs, "9")


async def test_libmodbus_talks_to_the_station_over_tcp(libmodbus: Path) -> None:
    station = ModbusStation(station=9, framing="tcp", holes=HOLE)
    async with station_on_tcp(station) as port:
        await finished(libmodbus / "modbus_master", "tcp", str(port), "9")


@NPM
@SOCAT
async def test_modbus_serial_talks_to_the_station_in_ascii(tmp_path: Path) -> None:
    station = ModbusStation(station=9, framing="ascii", holes=HOLE)
    async with pty_pair(tmp_path) as (ours, theirs), station_on_pty(ours, station):
        said = json.loads(await finished("node", "modbus_serial_client.js", theirs, "9"))
    assert said == {
        "words": [1, 2, 65535, 0xBEEF],
        "bits": [True, True, True, False],
        "refused": 2,
    }


# Device as its maker writes it, mbpoll's table (0 coils, 1 inputs, 4 registers), wire address.
MAPPED = [
    ("plain", "holding", 300, "4", 300),
    ("vigor", "M", 5119, "0", 5631),
    ("vigor", "X", 0o17, "1", 15),
    ("vigor", "T", 3, "4", 8195),
    ("k120s", "M", 0x10, "0", 0x1010),
    ("k120s", "D", 100, "4", 0x8064),
    ("ex485lnk", "holding", 4, "4", 4),
]


@MBPOLL
@SOCAT
@pytest.mark.parametrize(("dialect", "area", "number", "table", "wire"), MAPPED)
async def test_mbpoll_reads_the_station_on_a_pty(
    dialect: str, area: str, number: int, table: str, wire: int, tmp_path: Path
) -> None:
    station = ModbusStation(station=9, dialect=dialect)  # type: ignore[arg-type]  # from the table
    station.memory.write(area, number, [1])
    async with pty_pair(tmp_path) as (ours, theirs), station_on_pty(ours, station):
        line = ("-m", "rtu", "-b", "19200", "-P", "none", "-a", "9", "-o", str(PATIENCE))
        said = await finished(
            "mbpoll", *line, "-t", table, "-0", "-r", str(wire), "-c", "1", "-1", theirs
        )
    assert re.findall(r"\[(\d+)\]:\s+(\d+)", said) == [(str(wire), "1")]


@MBPOLL
async def test_mbpoll_writes_to_the_station_over_tcp() -> None:
    station = ModbusStation(station=9, framing="tcp")
    async with station_on_tcp(station) as port:
        where = ("-m", "tcp", "-p", str(port), "-a", "9", "-t", "4", "-0", "-r", "40")
        await finished("mbpoll", *where, "127.0.0.1", "5", "6", "7")
    assert station.memory.read("holding", 40, 3) == [5, 6, 7]


async def test_a_gateway_reads_pymodbus_by_datagrams(tmp_path: Path) -> None:
    """The server is ended and comes back."""
    port, endpoint = free_port(), free_endpoint()
    tags = {"level": {"address": "holding:70"}}
    device = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
    line = {"port": f"udp://127.0.0.1:{port}", "devices": {"oven": device}}
    file = write_config(tmp_path / "plant.yaml", endpoint, {"hall": line})
    server = (sys.executable, HERE / "pymodbus_server.py", "socket", "udp", str(port))
    with started(file):
        async with ZenohPeer("client", connect=[endpoint]) as client:
            for _ in range(2):
                async with running(*server, ready=b"ready"):
                    good = await client.get_until(
                        "plant/oven/level", lambda one: one["quality"] == "good"
                    )
                    assert good["value"] == 70
                bad = await client.get_until(
                    "plant/oven/level", lambda one: one["quality"] == "bad"
                )
                assert bad["reason"] in ("line-down", "no-reply")
