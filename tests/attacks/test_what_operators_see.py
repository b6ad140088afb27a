"""Six unclear writes, sixty operators and thirty-two garbled stations: what a person is told."""

import asyncio
import re
from pathlib import Path

from gateway.parts.audit.file import checked, read
from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import POLL, ZenohPeer, free_endpoint

WRITES, OPERATORS, STATIONS = 12, 60, 32
QUICK = {"reply_timeout": "50ms", "late_guard": "0s", "retries": 0}
ALARMS = "plant/@gateway/demo/alarms"


async def takes_no_write(
    _number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Replies to reads, and to writes never: each may or may not be done."""
    while True:
        request = await reader.readexactly(12)
        if request[7] == 3:
            writer.write(tcp_reply(request))


async def garbles(_number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while await reader.read(4096):
        writer.write(b"\xa5" * 20)


def plant(folder: Path, endpoint: str, unclear: int, garbled: int) -> Path:
    limits = {f"t{n}": {"address": f"D{n}", "alarm": {"low": 30_000}} for n in range(OPERATORS)}
    recipe = {"recipe": {"address": "holding:1", "write": True}}
    level = {"level": {"address": "holding:1", "every": "1s"}}
    modbus = {"protocol": "modbus-tcp", "station": 1, **QUICK}
    rtu = {**modbus, "protocol": "modbus-rtu", "tags": level}
    pumps = {f"pump{n}": {**rtu, "station": 1 + n} for n in range(STATIONS)}
    plc = {**modbus, "tags": recipe}
    lines = {
        "hall": vigor_line("simulator", limits),
        "net": {"port": f"tcp://127.0.0.1:{unclear}", "devices": {"plc": plc}},
        "yard": {"port": f"tcp://127.0.0.1:{garbled}", "devices": pumps},
    }
    return write_config(
        folder / "plant.yaml",
        endpoint,
        lines,
        gateway={"name": "demo", "audit": "audit.jsonl"},
        alarms={"path": "alarms.json"},
    )


async def test_operators_see_every_deed_and_each_cause_once(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with peer(takes_no_write) as unclear, peer(garbles) as garbled:
        file = plant(tmp_path, endpoint, unclear, garbled)
        with await asyncio.to_thread(started, file) as program:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                unclear = 0
                while unclear < WRITES:  # between them the device is offline
                    [reply] = await client.get("plant/plc/recipe/@set", b"%d" % unclear)
                    unclear += reply.json["error"] == "unclear"
                    await asyncio.sleep(POLL)

                key = f"{ALARMS}/mixer"
                while {one.json["state"] for one in await client.get(f"{key}/*")} != {"active"}:
                    await asyncio.sleep(POLL)
                answers = await client.many(
                    [(f"{key}/t{n}", b'{"by": "Ana %d"}' % n) for n in range(OPERATORS)]
                )
                told = {f"Ana {n}" for n, [one] in enumerate(answers) if one.ok}
                assert len(told) > 1  # a slow disk may leave out some, and they are told so

                line = await client.get_until(
                    f"{ALARMS}/line:yard", lambda alarm: alarm["state"] == "active"
                )
                assert (line["level"], len(line["devices"])) == ("silent", STATIONS)
                assert re.search(r"devices are silent, no frame to \d+% .* \(for ", line["detail"])
                pumps = [one.json for one in await client.get(f"{ALARMS}/pump$*")]
                assert {(one["state"], one["part_of"]) for one in pumps} == {
                    ("normal", "line:yard")
                }
                status = await asyncio.to_thread(plc_gateway, "status", file)
                [wrong] = re.findall(r"^wrong:\n((?: .*\n)+)", status.out, re.MULTILINE)
                assert re.search(r"line yard: .* devices are silent, no frame to ", wrong)
                assert wrong.count("silent") < 5  # causes: what comes late is another one
            assert await asyncio.to_thread(program.end) == 0
        assert len([line for line in program.lines if "write unclear" in line]) == WRITES
        for by in told:
            assert program.has_said("alarm acknowledged", repr(by)), by
    records = [*checked(read(tmp_path / "audit.jsonl"))]
    assert {record.why for record in records} == {""}
    events = [record.event for record in records]
    assert len([one for one in events if one.get("outcome") == "unclear"]) == WRITES
    assert {one["acknowledged"]["by"] for one in events if "acknowledged" in one} >= told
    assert events[-1] == {"event": "ends", "left_out": 0}
