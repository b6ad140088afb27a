"""Doors of a polled line, for programs nobody here wrote, to a slave nobody here wrote."""

import asyncio
import json
from functools import partial
from pathlib import Path
from typing import Any

from pymodbus import FramerType
from pymodbus.client import AsyncModbusTcpClient

from gateway.parts.audit.file import checked, read
from tests.conftest import needs
from tests.e2e.processes import plc_gateway, started, write_config
from tests.interop.peers import HERE, finished, pty_pair, running
from tests.zenoh_peer import ZenohPeer, free_endpoint, free_port

POLLED = 60  # tags


def config(folder: Path, port: Path, doors: dict[str, int]) -> tuple[Path, str]:
    """Returns the file and the endpoint; `doors`: protocols and ports."""
    endpoint = free_endpoint()
    press = {
        "protocol": "modbus-rtu",
        "station": 1,
        "tags": {f"t{n}": {"address": f"holding:{7 * n}"} for n in range(30, 30 + POLLED)},
    }
    share: dict[str, dict[str, Any]] = {
        protocol: {
            "line": "hall",
            "listen": f"127.0.0.1:{number}",
            "protocol": protocol,
            "most": "60%",
            "reply_within": "5s",
        }
        for protocol, number in doors.items()
    }
    for door in (one for protocol, one in share.items() if protocol != "raw"):
        door["writes"] = {"press": ["holding:100..holding:163", "coil:16..coil:36"]}
    hall = {"port": str(port), "baudrate": 19200, "format": "8N1", "devices": {"press": press}}
    own = {"name": "demo", "audit": str(folder / "audit.jsonl")}
    sections = {"gateway": own, "share": {"doors": share}}
    return write_config(folder / "hall.yaml", endpoint, {"hall": hall}, **sections), endpoint


async def test_four_programs_use_the_line_between_its_polls(
    libmodbus: Path, modbus_serial: str, socat: str, tmp_path: Path
) -> None:
    mbpoll, tcp, rtu, raw = needs("mbpoll"), free_port(), free_port(), free_port()
    doors = {"modbus-tcp": tcp, "modbus-rtu": rtu, "raw": raw}
    slave = libmodbus / "modbus_slave"
    async with (
        pty_pair(tmp_path) as (ours, theirs),
        running(slave, "rtu", theirs, "1", ready=b"ready"),
    ):
        file, endpoint = config(tmp_path, ours, doors)
        with started(file) as gateway:
            gateway.says("door open", "modbus-tcp")
            gateway.says("door open", "modbus-rtu")
            gateway.says("device online", "press")
            await finished(libmodbus / "modbus_master", "tcp", str(tcp), "1", "20")
            out = await finished(
                *(modbus_serial, HERE / "modbus_serial_client.js", str(tcp), "1", "tcp")
            )
            assert json.loads(out)["words"] == [1, 2, 65535, 0xBEEF]
            assert json.loads(out)["bits"] == [True, True, True, False]
            ask = (mbpoll, "-m", "tcp", "-p", str(tcp), "-0", "-1", "-a", "1", "-o", "5")
            both = await asyncio.gather(
                finished(*ask, "-t", "4", "-r", "500", "-c", "3", "127.0.0.1"),
                _pymodbus(rtu),
            )
            assert "[502]: \t502" in both[0]
            async with ZenohPeer("client", connect=[endpoint]) as peer:
                good = partial(_is, 280)
                await peer.get_until("plant/press/t40", good)
            [door] = [one for one in _doors(file) if one["protocol"] == "modbus-tcp"]
            assert (door["line"], door["trouble"], door["turned_away"]) == ("hall", "", 0)
            assert 0 < door["share"] < 1
            async with ZenohPeer("client", connect=[endpoint]) as peer:
                await _alone(raw, peer)
                await peer.get_until("plant/press/t40", good)
            assert gateway.end() == 0
    events = [record.event for record in checked(read(tmp_path / "audit.jsonl"))]
    writes = [one for one in events if one.get("key", "").startswith("plant/press/@")]
    assert {one["by"] for one in writes} == {
        "door modbus-tcp, 127.0.0.1",
        "door modbus-rtu, 127.0.0.1",
    }
    # One program tries a register that its door does not name.
    assert {one["outcome"] for one in writes} == {"written", "not-writable"}


async def _pymodbus(port: int) -> None:
    client = AsyncModbusTcpClient("127.0.0.1", port=port, framer=FramerType.RTU, timeout=5)
    assert await client.connect()
    try:
        assert not (await client.write_registers(110, [7, 8], device_id=1)).isError()
        found = await client.read_holding_registers(109, count=4, device_id=1)
        assert found.registers[1:3] == [7, 8]
        refused = await client.write_register(99, 1, device_id=1)
        assert refused.exception_code == 2  # outside `writes`
        refused = await client.read_holding_registers(10_000, count=1, device_id=1)
        assert refused.exception_code == 2  # the slave's own
    finally:
        client.close()


async def _alone(port: int, peer: ZenohPeer) -> None:
    """A program that has the wire alone: the values say so."""
    client = AsyncModbusTcpClient("127.0.0.1", port=port, framer=FramerType.RTU, timeout=5)
    assert await client.connect()
    try:
        assert (await client.read_holding_registers(9000, count=2, device_id=1)).registers[
            1
        ] == 9001
        maintained = partial(_has, "reason", "maintenance")
        await peer.get_until("plant/press/t40", maintained)
    finally:
        client.close()


def _has(field: str, text: str, document: Any) -> bool:
    return bool(document.get(field) == text)


def _is(value: int, document: Any) -> bool:
    return bool(document["quality"] == "good" and document["value"] == value)


def _doors(file: Path) -> list[dict[str, Any]]:
    done = plc_gateway("status", file, "--json")
    documents = done.json
    return [one for path, one in documents.items() if path.startswith("doors/")]
