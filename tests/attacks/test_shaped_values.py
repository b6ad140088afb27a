"""Shaped values at the real program: names, parts of a word, ranges, formulas, there and back."""

import struct
from pathlib import Path

from tests.e2e.processes import Program, started, station, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {
    "mode": {"address": "D500", "enum": {"0": "off", "1": "auto"}, "write": True},
    "status": {"address": "D501", "bits": {"0": "pump", "3": "fault"}, "write": True},
    "version": {"address": "D502", "type": "uint8", "byte": "high", "write": {"verify": True}},
    "level": {"address": "D503", "from": [4000, 20000], "to": [0, 100], "write": True},
    "flow": {"address": "D504", "type": "float32"},
    "sum": {"computed": "flow + level", "decimals": 2},
    "share": {"computed": "flow / mode"},
    "parts": {"address": "D510", "type": "uint16", "counter": True},
    "door": {"address": "M5", "debounce": "400ms"},
}


async def test_reads_writes_formulas_and_totals_at_the_real_program(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    line = vigor_line(str(tmp_path / "tty"), TAGS)
    gateway = {"name": "demo", "state": "state.json"}
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line}, gateway=gateway)
    high, low = struct.unpack(">2H", struct.pack(">f", 235.388))
    with station("pty", str(tmp_path / "tty")) as plc:
        for number, word in enumerate((1, 0b1000, 0x12FE, 12000, low, high), 500):
            plc.tell(f"set 1 D {number} {word}")
        plc.tell("set 1 D 510 65530")
        with started(config) as program:
            await _shaped(plc, endpoint)
            assert program.end() == 0
        plc.tell("set 1 D 510 10")
        with started(config):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                [reply] = await client.get("plant/mixer/parts?max_age=0s")
    assert reply.json["value"] == 65546


async def _shaped(plc: Program, endpoint: str) -> None:
    async with ZenohPeer("client", connect=[endpoint]) as client:

        async def read(tag: str) -> dict[str, object]:
            [reply] = await client.get(f"plant/mixer/{tag}?max_age=0s")
            found: dict[str, object] = reply.json
            return {name: value for name, value in found.items() if name != "time"}

        async def write(tag: str, payload: bytes) -> object:
            [reply] = await client.get(f"plant/mixer/{tag}/@set", payload)
            return reply.json.get("value", reply.json.get("error"))

        good = {"quality": "good"}
        computed = {**good, "origin": "computed"}
        assert await read("mode") == {"value": 1, "text": "auto", **good}
        assert await read("status/pump") == {"value": False, **good}
        assert await read("status/fault") == {"value": True, **good}
        assert await read("version") == {"value": 0x12, **good}
        assert await read("level") == {"value": 50.0, **good}
        assert await read("flow") == {"value": 235.388, **good}
        assert await read("sum") == {"value": 285.39, **computed}
        assert await read("share") == {"value": 235.388, **computed}

        assert await write("mode", b'"off"') == 0
        assert await write("mode", b"7") == "bad-value"
        assert await write("status/pump", b"true") is True
        assert await write("version", b"171") == 171
        assert await write("level", b"25") == 25.0
        assert await write("sum", b"1") == "not-writable"
        words = [int(plc.tell(f"get 1 D {number}")) for number in range(500, 504)]
        assert words == [0, 0b1001, 0xABFE, 8000]

        assert await read("sum") == {"value": 260.39, **computed}
        assert await read("share") == {
            "value": None,
            "quality": "bad",
            "reason": "not-a-number",
            "detail": "division by zero",
            "origin": "computed",
        }
        assert await read("parts") == {"value": 65530, **computed}
        plc.tell("set 1 D 510 3")
        assert await read("parts") == {"value": 65539, **computed}
        assert await read("door") == {"value": False, **good}
        door = await client.subscribe("plant/mixer/door")
        plc.tell("set 1 M 5 1")
        opened = await door.next(lambda sample: sample.json["value"] is True)
        assert opened.json["quality"] == "good"
        [meta] = await client.get("plant/mixer/level/@meta")
    assert (meta.json["type"], meta.json["raw_type"]) == ("float64", "int16")
