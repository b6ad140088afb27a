"""A whole line of the gateway, and its commands, with Modbus slaves of other authors."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.errors import WrongDevice
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.tags import Quality, Reason, WriteRule
from gateway.transport import Receiver, SerialPath, SerialSettings, TcpAddress, open_port
from tests.e2e.processes import plc_gateway, write_config
from tests.interop.peers import HERE, pty_pair, running
from tests.sim.bench import Bench
from tests.sim.plant import Plant, made_device, make_tag
from tests.sim.plant import running as serving
from tests.zenoh_peer import free_endpoint, free_port

Where = SerialPath | TcpAddress
Peer = Callable[[pytest.FixtureRequest, Path], AbstractAsyncContextManager[Where]]
SERIAL = WireTiming(19200, 10)
NETWORK = WireTiming(NETWORK_BAUD, 10)


@dataclass
class RealPort(Bench):
    """A real port that keeps the bytes."""

    where: Where = SerialPath("")  # noqa: RUF009 - immutable

    async def open(self, stations: Any, wire: WireTiming, ear: Receiver) -> "RealPort":
        self.ear = ear
        self.inner = await open_port(self.where, SerialSettings(19200, "8N1"), self)
        return self

    def lost(self, error: Exception) -> None:
        if self.ear is not None:
            self.ear.lost(error)


@asynccontextmanager
async def _pymodbus(folder: Path, framer: str, *, tcp: bool) -> AsyncIterator[Where]:
    server = (sys.executable, HERE / "pymodbus_server.py", framer)
    if tcp:
        port = free_port()
        async with running(*server, "tcp", str(port), ready=b"ready"):
            yield TcpAddress("127.0.0.1", port)
        return
    async with pty_pair(folder) as (ours, theirs), running(*server, theirs, ready=b"ready"):
        yield SerialPath(str(ours))


@asynccontextmanager
async def _program(folder: Path, *command: str | Path, tcp: bool) -> AsyncIterator[Where]:
    """A slave that takes `rtu DEVICE 1` or `tcp PORT`."""
    if tcp:
        port = free_port()
        async with running(*command, "tcp", str(port), ready=b"ready"):
            yield TcpAddress("127.0.0.1", port)
        return
    async with (
        pty_pair(folder) as (ours, theirs),
        running(*command, "rtu", theirs, "1", ready=b"ready"),
    ):
        yield SerialPath(str(ours))


def pymodbus(framer: str, *, tcp: bool) -> Peer:
    return lambda request, folder: _pymodbus(folder, framer, tcp=tcp)


def libmodbus(*, tcp: bool) -> Peer:
    return lambda request, folder: _program(
        folder, request.getfixturevalue("libmodbus") / "modbus_slave", tcp=tcp
    )


def modbus_serial(*, tcp: bool) -> Peer:
    return lambda request, folder: _program(
        folder, request.getfixturevalue("modbus_serial"), "modbus_serial_server.js", tcp=tcp
    )


PEERS = {
    "pymodbus-rtu-pty": (ModbusRtu(station=1), pymodbus("rtu", tcp=False)),
    "pymodbus-ascii-pty": (ModbusAscii(station=1), pymodbus("ascii", tcp=False)),
    "pymodbus-rtu-over-tcp": (ModbusRtu(station=1), pymodbus("rtu", tcp=True)),
    "pymodbus-ascii-over-tcp": (ModbusAscii(station=1), pymodbus("ascii", tcp=True)),
    "pymodbus-tcp": (ModbusTcp(), pymodbus("socket", tcp=True)),
    # No window with pymodbus: its server drops other received requests when it replies.
    "libmodbus-pty": (ModbusRtu(station=1), libmodbus(tcp=False)),
    "libmodbus-tcp": (ModbusTcp(), libmodbus(tcp=True)),
    "libmodbus-tcp-window": (ModbusTcp(window=8), libmodbus(tcp=True)),
    "modbus-serial-pty": (ModbusRtu(station=1), modbus_serial(tcp=False)),
    "modbus-serial-tcp": (ModbusTcp(), modbus_serial(tcp=True)),
}


def device_of(driver: Any, wire: WireTiming) -> Device:
    """Holding n holds n, input n 1000 + n, every third bit is on; 10000 of each."""
    texts = [f"holding:{n}" for n in (*range(100, 164), 500, 1000, 1500, 2000, 9999, 10000)]
    texts += [f"input:{n}" for n in range(5, 8)] + ["holding:2000.3"]
    texts += [f"{area}:{n}" for area in ("coil", "discrete") for n in range(20)]
    write = WriteRule(verify=True)
    tags = [make_tag(t, driver, type=_type(t), every=0.05, write=write) for t in texts]
    timing = replace(driver.timing, reply_timeout=10.0)
    return made_device("peer", driver, wire, timing, tuple(tags), 1.0)


def _type(text: str) -> str:
    return "bool" if "." in text or not text.startswith(("holding", "input")) else "uint16"


def expected(text: str) -> int | bool:
    if "." in text:
        return False  # bit 3 of 2000 = 7D0h
    area, number = text.split(":")[0], int(text.split(":")[1])
    match area:
        case "holding":
            return number
        case "input":
            return 1000 + number
    return number % 3 == 0


async def _write_and_read(line: Plant, device: Device, text: str, value: int) -> None:
    tag = next(tag for tag in device.tags if tag.text == text)
    async with asyncio.timeout(300):
        result = await line.line.write(device, tag, tag.encode(value))
    assert result.verified
    await until(lambda: line.now[tag].value == value)


async def _write_bit(line: Plant, device: Device, text: str) -> None:
    """By function 22, or, where the slave refuses it, by 06 and with a word about the race."""
    tag, begin = next(tag for tag in device.tags if tag.text == text), len(line.bench.sent)
    async with asyncio.timeout(300):
        result = await line.line.write(device, tag, tag.encode(True))
    sent = [data for _, data in line.bench.sent[begin:]]
    functions = [found for data in sent if (found := _function(device, data)) > 4]
    assert (result.verified, functions) == (True, [22] if result.note == "" else [22, 6])
    await until(lambda: line.now[tag].value is True)
    word = next(tag for tag in device.tags if tag.text == text.partition(".")[0])
    await until(lambda: line.now[word].value == 2000 | 1 << 3)


async def _write_group(line: Plant, device: Device, texts: list[str], function: int) -> None:
    """Fifty registers, or twenty bits, are one request: function 16, or 15."""
    tags = [next(tag for tag in device.tags if tag.text == text) for text in texts]
    bits = texts[0].startswith("coil")
    values = [n % 2 == 0 if bits else 3 * n for n in range(len(tags))]
    begin = len(line.bench.sent)
    pairs = zip(tags, values, strict=True)
    async with asyncio.timeout(300):
        ends = line.line.write_group(device, [(tag, tag.encode(value)) for tag, value in pairs])
        results = await asyncio.gather(*ends)
    assert all(result.verified for result in results)
    assert [result.value for result in results] == values
    sent = [data for _, data in line.bench.sent[begin:]]
    assert [found for data in sent if (found := _function(device, data)) > 4] == [function]


def _function(device: Device, data: bytes) -> int:
    match device.driver:
        case ModbusTcp():
            return data[7]
        case ModbusAscii():
            return int(data[3:5], 16)
    return data[1]


async def until(happened: Callable[[], bool]) -> None:
    async with asyncio.timeout(300):
        while not happened():
            await asyncio.sleep(0.01)


@pytest.mark.usefixtures("socat")
@pytest.mark.parametrize("name", PEERS)
async def test_a_whole_line_with(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """Every value is right, the missing register is found, writes are read back."""
    driver, peer = PEERS[name]
    async with peer(request, tmp_path) as where:
        wire = NETWORK if isinstance(where, TcpAddress) else SERIAL
        device = device_of(driver, wire)
        line = Plant([device], [], RealPort(where=where), wire)
        async with serving(line):
            missing = next(tag for tag in device.tags if tag.text == "holding:10000")
            await until(lambda: missing in line.now and line.reason(missing) is Reason.REFUSED)
            there = [tag for tag in device.tags if tag is not missing]
            await until(lambda: set(there) <= line.now.keys())
            await until(lambda: all(line.now[tag].quality is Quality.GOOD for tag in there))
            assert {tag.text: line.now[tag].value for tag in there} == {
                tag.text: expected(tag.text) for tag in there
            }
            for text, value in (("holding:100", 0xBEEF), ("coil:4", True), ("coil:3", False)):
                await _write_and_read(line, device, text, value)
            await _write_bit(line, device, "holding:2000.3")
            await _write_group(line, device, [f"holding:{n}" for n in range(149, 99, -1)], 16)
            await _write_group(line, device, [f"coil:{n}" for n in range(20)], 15)
        assert device.record.failures == {}
        assert device.record.exchanges > 10  # how many polls fit in depends on the machine


def quality(line: Plant) -> Quality | Reason | None:
    """Of its only tag; the reason of a bad one."""
    sample = next(iter(line.now.values()), None)
    return None if sample is None else sample.reason or sample.quality


def meter(port: int, model: str) -> AbstractAsyncContextManager[object]:
    """A pymodbus server that tells its model."""
    command = (sys.executable, HERE / "pymodbus_server.py", "socket", "tcp", str(port))
    return running(*command, "ABB", model, ready=b"ready")


async def test_two_swapped_meters_are_bad_until_they_are_swapped_back() -> None:
    models = ("A1", "B2")
    ports = [free_port(), free_port()]
    plants = []
    for port, model in zip(ports, models, strict=True):
        driver = ModbusTcp()
        tags = (make_tag("holding:100", driver, every=0.05, write=WriteRule()),)
        own = {"vendor": "ABB", "model": model}
        device = made_device(model, driver, NETWORK, driver.timing, tags, identity=own)
        where = TcpAddress("127.0.0.1", port)
        plants.append(Plant([device], [], RealPort(where=where), NETWORK))

    async with serving(plants[0]), serving(plants[1]):
        for order, expected_ in (
            (models, Quality.GOOD),
            (models[::-1], Reason.WRONG_DEVICE),
            (models, Quality.GOOD),
        ):
            one, other = (meter(*pair) for pair in zip(ports, order, strict=True))
            async with one, other:
                await until(lambda: all(quality(plant) is expected_ for plant in plants))  # noqa: B023
                for plant in plants:
                    device = plant.devices[0]
                    writing = plant.line.write(device, device.tags[0], [7])
                    if expected_ is Reason.WRONG_DEVICE:
                        with pytest.raises(WrongDevice):
                            await writing
                    else:
                        await writing
            await until(lambda: all(quality(plant) is Reason.LINE_DOWN for plant in plants))


@pytest.mark.usefixtures("socat")
async def test_libmodbus_tells_its_serial_by_function_17_alone(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """It is silent about function 43."""
    async with libmodbus(tcp=False)(request, tmp_path) as where:
        driver = ModbusRtu(station=1)
        tags = (make_tag("holding:100", driver, every=0.05),)
        identity = {"serial": "LMB0"}
        device = made_device("peer", driver, SERIAL, driver.timing, tags, identity=identity)
        line = Plant([device], [], RealPort(where=where), SERIAL)
        async with serving(line):
            await until(lambda: quality(line) is Reason.WRONG_DEVICE)
        assert device.identity is not None
        assert [word for word in device.identity.told["serial"] if word.startswith("LMB3")]


@pytest.mark.usefixtures("socat")
async def test_libmodbus_cannot_tell_its_vendor_and_is_read_all_the_same(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    async with libmodbus(tcp=False)(request, tmp_path) as where:
        driver = ModbusRtu(station=1)
        tags = (make_tag("holding:100", driver, every=0.05),)
        identity = {"vendor": "ABB"}
        device = made_device("peer", driver, SERIAL, driver.timing, tags, identity=identity)
        line = Plant([device], [], RealPort(where=where), SERIAL)
        async with serving(line):
            await until(lambda: tags[0] in line.now and line.now[tags[0]].value == 100)
        assert "silent about its identity" in device.diagnosis()


@pytest.mark.usefixtures("socat")
async def test_direct_commands_read_and_write_a_slave(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """In a process of its own, from the file to the exit code."""
    async with libmodbus(tcp=False)(request, tmp_path) as where:
        assert isinstance(where, SerialPath)
        tags = {
            "n": {"address": "holding:321", "write": True},
            "third": {"address": "coil:9"},
            "missing": {"address": "holding:20000"},
        }
        slave = {"protocol": "modbus-rtu", "station": 1, "tags": tags}
        line = {"port": where.path, "baudrate": 19200, "format": "8N1", "devices": {"plc": slave}}
        config = write_config(tmp_path / "config.yaml", free_endpoint(), {"hall": line})
        call = asyncio.to_thread
        done = await call(plc_gateway, "write", config, "plc/n", "77", "--direct", "--json")
        assert (done.code, done.json["value"]) == (0, 77)
        done = await call(plc_gateway, "read", config, "--direct", "--json")
        rows = {row["tag"]: row for row in map(json.loads, done.out.splitlines())}
        assert (rows["plc/n"]["value"], rows["plc/third"]["value"]) == (77, True)
        assert (rows["plc/missing"]["quality"], rows["plc/missing"]["reason"]) == ("bad", "refused")
        assert done.code == 1
