"""docs/security.md, limits: a client that goes beyond each, while others are served."""

import asyncio
from collections import Counter
from pathlib import Path

from tests.attacks.security_pages import client, quoted, table
from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import Reply, ZenohPeer, free_endpoint

MESSAGE, PAYLOAD, OPEN, WIDE, _PEEKS, _ORDERS, WRITES = (
    int(row[1].replace(",", "").replace("a JSON value of ", "").split()[0])
    for row in table("Limits")
)
RECIPE = "plant/press/recipe/@set"
PUTS = 20_000  # the gateway receives them faster than it can refuse each by itself


class Press:
    """A Modbus TCP device that answers while it `speaks`."""

    def __init__(self) -> None:
        self.speaks = asyncio.Event()
        self.speaks.set()

    async def serve(
        self, _number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            request = await reader.readexactly(12)
            await self.speaks.wait()
            writer.write(request if request[7] == 6 else tcp_reply(request))


def ends(answers: list[list[Reply]]) -> Counter[str]:
    """Counts the error words of queries; `waits` where the client has gone before the answer."""
    found = Counter[str]()
    for replies in answers:
        last = replies[-1] if replies else None
        if last is None or last.ok:
            found["ok" if last else "none"] += 1
        elif last.payload == b"Timeout":
            found["waits"] += 1
        else:
            found[last.json["error"]] += 1
    return found


async def test_no_client_gets_beyond_the_limits_or_delays_another_line(tmp_path: Path) -> None:
    quoted("No load from clients delays the lines")
    endpoint, plc = free_endpoint(), Press()
    async with peer(plc.serve) as port:
        tags = {"recipe": {"address": "holding:7", "type": "uint16", "write": True}}
        press = {"protocol": "modbus-tcp", "station": 1, "reply_timeout": "20s", "tags": tags}
        lines = {
            "net": {"port": f"tcp://127.0.0.1:{port}", "devices": {"press": press}},
            "hall": vigor_line("simulator", {"speed": {"address": "D100"}}),
        }
        file = write_config(tmp_path / "plant.yaml", endpoint, lines)
        with await asyncio.to_thread(started, file) as program:
            await asyncio.to_thread(program.says, "device online", "press")
            async with client(endpoint) as attacker, client(endpoint) as beside:
                await too_long(attacker)
                plc.speaks.clear()
                polls = await reads_of_the_mixer(beside)
                floods = {
                    WRITES: ((RECIPE, b"7"), WRITES + 40),
                    WIDE: (("plant/press/**?max_age=0s", None), WIDE + 20),
                    OPEN: (("plant/press/recipe?max_age=0s", None), OPEN + 20),
                }
                queries = [query for query, count in floods.values() for _ in range(count)]
                answers = await attacker.many(queries, 3.0)
                whole = ends(answers)
                assert 0 < whole["waits"] <= OPEN + WRITES
                for limit, (_, count) in floods.items():
                    found, answers = ends(answers[:count]), answers[count:]
                    assert 0 < found["waits"] <= limit
                    assert found["busy"] + found["none"] == count - found["waits"] > 0
                quoted("are counted there as `puts_refused` and `refused`")
                await attacker.put(RECIPE, b"7", times=PUTS)
                plc.speaks.set()
                await beside.get_until(
                    "plant/@gateway/demo/zenoh",
                    lambda counted: counted.get("refused", 0) > 0 < counted.get("puts_refused", 0),
                )
                assert await reads_of_the_mixer(beside) > polls + 2


async def reads_of_the_mixer(client: ZenohPeer) -> int:
    [device] = await client.get("plant/@gateway/demo/devices/mixer")
    reads: int = device.json["requests"][0]["reads"]
    return reads


async def too_long(attacker: ZenohPeer) -> None:
    """A payload beyond the limit is refused; Zenoh drops a message beyond its own."""
    [reply] = await attacker.get(RECIPE, b" " * PAYLOAD * 1024 + b"7")
    assert reply.json["error"] == "bad-value"
    [reply] = await attacker.get(RECIPE, b" " * MESSAGE * 1024 + b"7", timeout=0.5)
    assert reply.payload == b"Timeout"
    [reply] = await attacker.get(RECIPE, b" " * (PAYLOAD * 1024 - 1) + b"7")
    assert reply.ok
