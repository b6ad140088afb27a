"""Modbus/TCP Security beside pymodbus: its servers are asked, and its client asks, over TLS."""

import asyncio
import ssl
from pathlib import Path
from typing import Any, cast

import pytest
from pymodbus import FramerType
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.server import ModbusTlsServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import CommParams, CommType

from gateway.cli.line import direct
from gateway.config import built
from gateway.contract.access.certificates import role
from gateway.errors import ConfigError
from gateway.parts.serving.served_line import ServedLine
from gateway.tags import Quality, good
from tests.e2e.processes import plc_gateway, started, write_config
from tests.interop.test_served_lines import ACCEPT, TAGS, Plant
from tests.transport.authority import Authority
from tests.zenoh_peer import free_endpoint, free_port


class SecureClient(AsyncModbusTcpClient):
    """pymodbus' client over TLS, with the frames of Modbus/TCP Security: its own has no header."""

    def __init__(self, port: int, context: ssl.SSLContext) -> None:
        self.comm_params = CommParams(
            comm_type=CommType.TLS,
            host="127.0.0.1",
            port=port,
            sslctx=context,
            comm_name="comm",
            timeout_connect=3,
        )
        AsyncModbusTcpClient.__init__(self, "", framer=FramerType.SOCKET)


def tls_of(plant: Authority, owner: str, **more: Any) -> dict[str, Any]:
    certificate, key = plant.issue(owner)
    return {"ca": str(plant.ca), "certificate": str(certificate), "key": str(key), **more}


@pytest.mark.parametrize("protocol", ["modbus-tcp", "modbus-rtu"])
async def test_a_server_is_asked_over_tls(tmp_path: Path, protocol: str) -> None:
    plant, number = Authority(tmp_path), free_port()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*plant.issue("boiler"))
    context.load_verify_locations(plant.ca)
    context.verify_mode = ssl.CERT_REQUIRED
    holding = SimData(0, values=list(range(100)), datatype=DataType.REGISTERS)
    server = ModbusTlsServer(
        [SimDevice(id=1, simdata=[holding])],
        framer=FramerType.SOCKET if protocol == "modbus-tcp" else FramerType.RTU,
        address=("127.0.0.1", number),
        sslctx=context,
    )
    await server.serve_forever(background=True)
    device = {"protocol": protocol, "station": 1, "tags": {"level": {"address": "holding:7"}}}
    line = {
        "port": f"tls://localhost:{number}",
        "tls": tls_of(plant, "gateway"),
        "devices": {"boiler": device},
    }
    config = built({"lines": {"hall": line}})
    [sample] = await direct.read(config, config.devices[0].tags)
    assert (sample.value, sample.quality) == (7, Quality.GOOD)
    await cast("Any", server).shutdown()


async def test_the_role_in_the_certificate_of_a_master_says_if_it_may_write(
    tmp_path: Path,
) -> None:
    plant, number, written = Authority(tmp_path), free_port(), Plant()
    device = {"protocol": "modbus-tcp", "station": 1, "accept": ACCEPT, "tags": TAGS}
    tls = tls_of(plant, "panel", mutual=True, writers=["Operator"])
    served = {"port": f"tls://127.0.0.1:{number}", "serve": True, "tls": tls}
    [config] = built({"lines": {"panel": served | {"devices": {"hmi": device}}}}).lines
    line = ServedLine(config, written, lambda row: good(row.tag, 70000, 0))
    task = asyncio.create_task(line.run())
    while not line.is_open:
        await asyncio.sleep(0)
    for found, answers in (("Operator", None), ("Viewer", 1), (None, 1)):
        client = SecureClient(number, shown(plant, found))
        assert await client.connect()
        read = await client.read_holding_registers(10, count=2, device_id=1)
        assert read.registers == [70000 & 0xFFFF, 1]
        wrote = await client.write_register(100, 300, device_id=1)
        assert (wrote.exception_code if wrote.isError() else None) == answers
        client.close()
    assert written.written("order") == [300]
    task.cancel()
    await asyncio.wait([task])


async def test_the_role_of_a_program_says_if_it_may_write_at_a_door(tmp_path: Path) -> None:
    """The gateway is the real program; a raw door takes no program without a role."""
    plant, port, raw = Authority(tmp_path), free_port(), free_port()
    press = {"protocol": "modbus-rtu", "station": 1, "tags": {"t": {"address": "holding:10"}}}
    tls = tls_of(plant, "gateway", mutual=True, writers=["Operator"])
    doors: dict[str, dict[str, Any]] = {
        name: {"line": "hall", "listen": f"127.0.0.1:{number}", "protocol": name, "tls": tls}
        for name, number in (("modbus-tcp", port), ("raw", raw))
    }
    doors["modbus-tcp"]["writes"] = {"press": ["holding:100..holding:110"]}
    file = write_config(
        tmp_path / "hall.yaml",
        free_endpoint(),
        {"hall": {"port": "simulator", "devices": {"press": press}}},
        share={"doors": doors},
    )
    with started(file) as gateway:
        gateway.says("door open", "modbus-tcp")
        gateway.says("device online", "press")
        contexts = [shown(plant, role) for role in ("Operator", "Viewer", None)]
        for context, answers in zip(contexts, (None, 2, 2), strict=True):
            client = SecureClient(port, context)
            assert await client.connect()
            assert not (await client.read_holding_registers(10, count=2, device_id=1)).isError()
            wrote = await client.write_register(100, 300, device_id=1)
            assert (wrote.exception_code if wrote.isError() else None) == answers
            client.close()
        reader, writer = await asyncio.open_connection("127.0.0.1", raw, ssl=contexts[1])
        assert await reader.read() == b""
        writer.close()
        done = await asyncio.to_thread(plc_gateway, "status", file, "--json")
        assert done.json["doors/raw"]["turned_away"] == 1
        assert "certificates/share.doors.raw.tls.certificate" in done.json
        assert gateway.end() == 0


def shown(plant: Authority, role: str | None) -> ssl.SSLContext:
    """Returns the context of a program with a certificate of this role."""
    certificate, key = plant.issue("scada", role=role)
    context = ssl.create_default_context(cafile=plant.ca)
    context.load_cert_chain(certificate, key)
    return context


def test_one_address_is_one_line_whatever_its_scheme(tmp_path: Path) -> None:
    device = {"protocol": "modbus-rtu", "station": 1, "tags": {"level": {"address": "holding:7"}}}
    lines: dict[str, dict[str, Any]] = {
        "hall": {"port": "tcp://a:502", "connection": {"also": ["b:502"]}},
        "other": {"port": "rfc2217://b:502"},
    }
    for number, line in enumerate(lines.values()):
        line["devices"] = {f"d{number}": device}
    with pytest.raises(ConfigError, match="line hall has this port already"):
        built({"lines": lines}, tmp_path)


def test_only_the_extension_is_a_role(tmp_path: Path) -> None:
    plant = Authority(tmp_path)

    def of(name: str, **more: Any) -> str:
        certificate, _ = plant.issue(name, **more)
        return role(ssl.PEM_cert_to_DER_cert(certificate.read_text()))

    assert of("a", role="Operator") == "Operator"
    assert of("a") == ""
    assert of("a", role="Operator", oid="1.3.6.1.4.1.50316.802.2") == ""
    assert role(b"") == role(b"\x30\x03\x30\x01\xa3") == ""


@pytest.mark.parametrize(
    ("port", "line", "says"),
    [
        ("tls://a:802", {}, "missing: a port tls:// needs `tls: {ca: ca.pem}`"),
        ("tls://a:802", {"tls": {}}, "write the authority that signs the certificate there"),
        ("tcp://a:502", {"tls": {"ca": "ca.pem"}}, "certificates are for a port tls:// or listen"),
        ("listen://a:502", {"tls": {"ca": "ca.pem"}}, "the side that listens shows a certificate"),
        (
            "tls://a:802",
            {"tls": {"certificate": "gateway.pem", "key": "gateway.key"}, "serve": True},
            None,
        ),
        (
            "tls://a:802",
            {
                "tls": {"certificate": "gateway.pem", "key": "gateway.key", "writers": ["x"]},
                "serve": True,
            },
            "they need `serve: true` and `mutual: true`",
        ),
        (
            "listen://a:802",
            {"tls": {"certificate": "gateway.pem", "key": "gateway.key", "name": "x"}},
            "it needs `mutual: true`",
        ),
        ("tls://a:802", {"tls": {"ca": "no.pem"}}, "ca: there is no file"),
        ("tcp://a:502", {"connection": {"also": ["[::1]:5", "b:6"], "bind": "::1"}}, None),
        ("listen://a:502", {"connection": {}}, "only a port tcp://, tls:// or rfc2217:// that"),
        ("tcp://a:502", {"connection": {"keepalive": "2h"}}, "the system asks after 1s to 1h"),
        ("tcp://a:502", {"connection": {"bind": "eth0"}}, "'eth0' is no address of this computer"),
        ("tcp://a:502", {"connection": {"also": ["b:1"] * 4}}, "at most 3 more addresses"),
    ],
)
def test_settings_of_connections(
    tmp_path: Path, port: str, line: dict[str, Any], says: str | None
) -> None:
    Authority(tmp_path).issue("gateway")
    device = {"protocol": "modbus-tcp", "tags": {"level": {"address": "holding:7"}}}
    if line.get("serve"):
        device["tags"]["level"]["write"] = True  # type: ignore[index]
    data = {"lines": {"hall": {"port": port, **line, "devices": {"boiler": device}}}}
    if says is None:
        built(data, tmp_path)
        return
    with pytest.raises(ConfigError) as caught:
        built(data, tmp_path)
    assert says in str(caught.value)
