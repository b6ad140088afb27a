"""A station of a PLC's communication table is served: the PLC stays the master of its line."""

import asyncio
from pathlib import Path

import pytest
import yaml
from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient

from tests.attacks.test_served_lines import Wire
from tests.conftest import Command
from tests.e2e.processes import Program, plc_gateway, started
from tests.interop.peers import pty_pair
from tests.serving.easy_link import EXAMPLE, EasyLink
from tests.sheets.test_link_table import LINK, LINK_REGISTERS, MBUS, registers
from tests.zenoh_peer import ZenohPeer, free_endpoint


def served(folder: Path, table: str, port: str, endpoint: str, *stations: int) -> Path:
    """Returns the printed file, with the port of the test."""
    sheet, file = folder / "table.csv", folder / "plant.yaml"
    sheet.write_text(table)
    options = [part for one in stations for part in ("--serve", one)]
    done = plc_gateway("import", sheet, *options)
    assert done.code == 0, done.err
    assert done.out.count("/dev/ttyUSB0") == 1
    top = f"gateway: {{name: demo}}\nzenoh: {{prefix: plant, listen: [{endpoint}]}}\n"
    file.write_text(top + done.out.replace("/dev/ttyUSB0", port))
    checked = plc_gateway("check", file)
    assert checked.code == 0, checked.out + checked.err
    return file


def ready(program: Program) -> None:
    program.says("line open", "line=master-plc")


@pytest.mark.parametrize("table", [LINK, registers(LINK_REGISTERS)])
async def test_the_manuals_easy_link_master_reads_and_writes_the_gateway(
    tmp_path: Path, table: str
) -> None:
    with Wire() as wire:
        file = served(tmp_path, table, wire.path, endpoint := free_endpoint(), 5, 2)
        with started(file) as program:
            ready(program)
            async with ZenohPeer("client", connect=[endpoint]) as client:
                seen = await client.subscribe("plant/station-2/**")
                for number in range(10):
                    key = f"plant/station-5/d{10 + number}/@set"
                    [done] = await client.get(key, b"%d" % (700 + number))
                    assert done.ok
                master = EasyLink(wire.exchange)
                master.devices = {(3, n): n % 2 for n in range(30)}
                assert await asyncio.to_thread(master.perform, EXAMPLE) == ["00", "00"]
                assert [master.devices[13, n] for n in range(10)] == [*range(700, 710)]
                await seen.next(lambda one: one.key == "plant/station-2/m129" and one.json["value"])
                values = {one.key.rpartition("/")[2]: one.json["value"] for one in seen.samples}
                assert values == {f"m{100 + n}": n % 2 == 1 for n in range(30)}
                # The master writes what its table says, and a client does not write it.
                [refused] = await client.get("plant/station-2/m100/@set", b"true")
                assert refused.json["error"] == "not-writable"
                beyond = EXAMPLE[1]._replace(its_first=104)
                assert await asyncio.to_thread(master.perform, [beyond]) == ["28"]
            assert program.end() == 0


async def test_a_modbus_master_reads_and_writes_the_gateway_by_its_mbus_table(
    tmp_path: Path, socat: str
) -> None:
    endpoint = free_endpoint()
    async with pty_pair(tmp_path) as (ours, theirs):
        file = served(tmp_path, MBUS, str(ours), endpoint, 5, 2, 3)
        with started(file) as program:
            ready(program)
            peer = AsyncModbusSerialClient(str(theirs), framer=FramerType.RTU, baudrate=19200)
            async with ZenohPeer("client", connect=[endpoint]) as client:
                seen = await client.subscribe("plant/**")
                assert await peer.connect()
                for number in range(10):
                    [done] = await client.get(
                        f"plant/station-5/holding-{number}/@set", b"%d" % (300 + number)
                    )
                    assert done.ok
                read = await peer.read_holding_registers(0, count=10, device_id=5)
                assert read.registers == [*range(300, 310)]
                written = await peer.write_registers(1000, [1, 2, 3, 4, 5], device_id=2)
                assert not written.isError()
                single = await peer.write_register(2000, 77, device_id=3)
                assert not single.isError()
                for station, address in ((5, 0), (2, 1005), (3, 2001)):  # not in the table
                    refused = await peer.write_registers(address, [9], device_id=station)
                    assert refused.exception_code == 2
                await seen.next(lambda one: one.key == "plant/station-3/holding-2000")
                values = {one.key: one.json["value"] for one in seen.samples}
                for n in range(5):
                    assert values[f"plant/station-2/holding-{1000 + n}"] == n + 1
                assert values["plant/station-3/holding-2000"] == 77
                peer.close()
            assert program.end() == 0


@pytest.mark.parametrize(
    ("table", "station", "said"),
    [
        (LINK, 7, "no row for station 7: it has 5, 2"),
        ("Name,Address\na,D1\n", 5, "is no communication table"),
        (LINK.replace("D10,", "Q10,"), 5, "Q10: there is no device Q"),
    ],
)
def test_a_mistake_prints_no_line(
    command: Command, tmp_path: Path, table: str, station: int, said: str
) -> None:
    sheet = tmp_path / "table.csv"
    sheet.write_text(table)
    done = command("import", sheet, "--serve", station)
    assert (done.code, done.out) == (2, "")
    assert said in done.err


def test_an_option_that_would_be_ignored_is_refused(command: Command, tmp_path: Path) -> None:
    (sheet := tmp_path / "table.csv").write_text(LINK)
    for more in (("--into", "plant.yaml"), ("--device", "x"), ("--transfers", "plc")):
        done = command("import", sheet, "--serve", 5, *more)
        assert (done.code, done.out) == (2, "")
        assert "leave out --into" in done.err


def test_a_word_that_is_read_and_written_is_the_masters(command: Command, tmp_path: Path) -> None:
    sheet = tmp_path / "table.csv"
    sheet.write_text(
        "Command,Master Data,Slave ID,Slave Data,Length\nRead,D0,1,D5,2\nWrite,D9,1,D6,1\n"
    )
    done = command("import", sheet, "--serve", 1)
    device = yaml.safe_load(done.out)["lines"]["master-plc"]["devices"]["station-1"]
    assert device["accept"] == ["D6"]
    assert {name: "write" in tag for name, tag in device["tags"].items()} == {
        "d6": False,
        "d5": True,
    }
