"""Values that clients write and a master reads."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.line import direct
from gateway.config import built
from gateway.errors import BadValue, Busy
from gateway.parts.serving.part import ServingPart
from gateway.plant.plant import Plant
from gateway.stations.store import Denied
from gateway.tags import Quality, Reason, Tag, WriteResult, bad, good
from gateway.transport import TcpAddress, listen
from gateway.values import Value
from tests.parts.made import parts_of
from tests.writing import write
from tests.zenoh_peer import free_port

TAGS = {
    "limit": {"address": "holding:1", "write": {"max": 50}, "retain": True},
    "name": {"address": "holding:10", "type": "string[4]", "write": True},
    "order": {"address": "holding:100"},
    "steps": {"address": "holding:20", "type": "int16[3]", "write": True, "retain": True},
}


def gateway(folder: Path) -> Plant:
    return plant({"gateway": {"state": "state.json"}}, TAGS, folder)


def plant(top: dict[str, Any], tags: dict[str, Any], folder: Path) -> Plant:
    hmi = {"protocol": "modbus-tcp", "accept": ["holding:100"], "tags": tags}
    panel = {"port": "tcp://127.0.0.1:502", "serve": True, "devices": {"hmi": hmi}}
    mixer = {"protocol": "vigor", "station": 1, "tags": {"speed": {"address": "D0"}}}
    hall = {"port": "/dev/ttyS99", "devices": {"mixer": mixer}}
    made = Plant(built({**top, "lines": {"hall": hall, "panel": panel}}, folder))
    parts_of(made, "serving")
    return made


def served(of: Plant) -> ServingPart:
    [store] = of.doors.stores
    assert isinstance(store, ServingPart)
    return store


def tag(of: Plant, name: str) -> Tag:
    found = of.tag(f"hmi/{name}")
    assert found is not None
    return found


async def test_a_held_value_is_on_the_disk_before_it_is_acknowledged(tmp_path: Path) -> None:
    first = gateway(tmp_path)
    assert (await write(first, tag(first, "limit"), 42)).value == 42
    assert (await write(first, tag(first, "name"), "AB")).value == "AB"
    assert (await write(first, tag(first, "steps"), (1, -2, 3))).value == (1, -2, 3)
    again = gateway(tmp_path)
    await served(again).begin()
    assert again.sample(tag(again, "limit")).value == 42
    assert again.sample(tag(again, "steps")).value == (1, -2, 3)
    assert again.sample(tag(again, "name")).quality is Quality.BAD  # without `retain`


async def test_a_value_that_cannot_be_kept_is_refused_and_not_shown(tmp_path: Path) -> None:
    one = gateway(tmp_path)
    await write(one, tag(one, "limit"), 42)
    (tmp_path / "state.held.json").unlink()
    tmp_path.rmdir()
    with pytest.raises(Busy, match=r"No such file or directory.*; not done"):
        await write(one, tag(one, "limit"), 43)
    assert one.sample(tag(one, "limit")).value == 42
    with pytest.raises(BadValue):
        await write(one, tag(one, "limit"), 51)


async def test_several_held_values_change_all_at_once_or_none(tmp_path: Path) -> None:
    one = gateway(tmp_path)
    values: list[tuple[Tag, Value]] = [(tag(one, "limit"), 42), (tag(one, "name"), "AB")]
    ends = await one.write_group(values)
    assert [end.value for end in ends if isinstance(end, WriteResult)] == [42, "AB"]
    assert one.sample(values[0][0]).time == one.sample(values[1][0]).time
    with pytest.raises(BadValue, match="greatest value 50"):
        await one.write_group([(tag(one, "name"), "CD"), (tag(one, "limit"), 51)])
    with pytest.raises(BadValue, match="written by the master"):
        await one.write_group([(tag(one, "name"), "CD"), (tag(one, "order"), 1)])
    assert one.sample(tag(one, "name")).value == "AB"


async def test_a_held_value_without_a_state_file_is_lost_with_the_process(tmp_path: Path) -> None:
    one = plant({}, {"limit": {"address": "holding:1", "write": True}}, tmp_path)
    await served(one).begin()
    began = asyncio.get_running_loop().time()
    written = await write(one, tag(one, "limit"), 42)
    assert (written.value, written.verified, written.took < began) == (42, False, True)
    assert one.sample(tag(one, "limit")).value == 42


async def test_a_master_reads_the_last_good_value_of_a_source_that_turned_bad(
    tmp_path: Path,
) -> None:
    """Nobody read it while it was good."""
    row: dict[str, Any] = {"source": "mixer/speed", "type": "uint16"}
    kept = {**row, "address": "holding:2", "hold_last": True}
    one = plant({}, {"now": {**row, "address": "holding:1"}, "last": kept}, tmp_path)
    [line] = served(one).lines
    [station] = line.stations.values()
    speed = one.tag("mixer/speed")
    assert speed is not None
    one.samples([good(speed, 7, 0)])
    one.samples([bad(speed, Reason.NO_REPLY, 1)])
    assert station.registers.read("holding", 2, 1) == [7]
    with pytest.raises(Denied):
        station.registers.read("holding", 1, 1)
    one.samples([good(speed, 8, 2)])
    assert station.registers.read("holding", 1, 2) == [8, 8]


async def test_a_damaged_file_of_held_values_is_moved_aside(tmp_path: Path) -> None:
    (tmp_path / "state.held.json").write_text('{"form": 1, "held": [')
    one = gateway(tmp_path)
    await served(one).begin()
    assert one.sample(tag(one, "limit")).quality is Quality.BAD
    assert (tmp_path / "state.held.json.bad").exists()


async def test_a_held_value_outside_new_limits_or_without_retain_is_dropped(tmp_path: Path) -> None:
    held = '{"form": 1, "held": {"hmi/limit": 51, "hmi/name": "AB"}}'
    (tmp_path / "state.held.json").write_text(held)
    one = gateway(tmp_path)
    await served(one).begin()
    for name in ("limit", "name"):
        assert one.sample(tag(one, name)).quality is Quality.BAD


async def test_direct_access_sends_nothing_on_the_wire_of_a_master(tmp_path: Path) -> None:
    config = gateway(tmp_path).config
    tags = config.devices[1].tags
    order, limit = tags[2], tags[0]
    [sample] = await direct.read(config, [order])
    assert sample.reason is Reason.LINE_DOWN
    with pytest.raises(BadValue, match="only the running gateway has it"):
        await direct.write_group(config, [(limit, 1)])


Ends = list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]


async def connected(number: int, count: int) -> Ends:
    return [await asyncio.open_connection("127.0.0.1", number) for _ in range(count)]


async def ask_all(ends: Ends) -> None:
    for reader, writer in ends:
        writer.write(bytes.fromhex("0001 0000 0006 01 06 0064 0001"))
        assert len(await reader.readexactly(12)) == 12


async def test_a_connection_ends_with_bytes_that_are_no_modbus_and_the_next_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listen, "_BUSY", 600.0)  # on any machine
    assert listen.MOST_CONNECTIONS == 32
    one = gateway(tmp_path)
    [line] = served(one).lines
    number = free_port()
    line.config = replace(line.config, port=TcpAddress("127.0.0.1", number))
    task = asyncio.create_task(line.run())
    while not line.is_open:
        await asyncio.sleep(0)
    for _ in range(3):
        reader, writer = await asyncio.open_connection("127.0.0.1", number)
        writer.write(b"GET / HTTP/1.1\r\n\r\n")
        assert await reader.read() == b""
        writer.close()
        await writer.wait_closed()
    ends = await connected(number, 30)
    await ask_all(ends)
    silent = await connected(number, 2)  # later than the last bytes of the others
    ends += await connected(number, 2)
    await ask_all(ends[30:])
    for reader, writer in silent:
        assert await reader.read() == b""
        writer.close()
    ends += await connected(number, 1)
    assert await ends[-1][0].read() == b""  # one too many: all are busy
    task.cancel()
    await asyncio.wait([task])
    assert await ends[0][0].read() == b""
    for _, writer in ends:
        writer.close()
