"""A gateway is held (SIGSTOP) and wakes: what it was asked to write before is not written."""

import asyncio
import sys
from contextlib import ExitStack
from pathlib import Path

from gateway.line.arrival import HELD
from gateway.northbound.group.election import LONGEST_PAUSE
from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import Program, free_port, held, started, station, vigor_line, write_config
from tests.zenoh_peer import POLL, TIMEOUT, ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
HOLD = HELD + 0.3  # seconds
# The command itself; the waits of the election are shorter, so that the suite is.
RUN = """
import gateway.northbound.group.election as election
election.SETTLE_TIME, election.CLAIM_TIME = 0.3, 0.8
from gateway.cli.main import main
main()
"""


async def until_taken(client: ZenohPeer, payload: bytes) -> None:
    """Writes until the gateway has forgotten its hold."""
    async with asyncio.timeout(TIMEOUT):
        while not (await client.get(RECIPE, payload))[0].ok:
            await asyncio.sleep(POLL)


async def test_a_write_that_arrived_while_the_gateway_was_held_is_refused(tmp_path: Path) -> None:
    endpoint, port = free_endpoint(), free_port()
    tags = {"recipe": {"address": "D500", "write": True}}
    lines = {"hall": vigor_line(f"tcp://127.0.0.1:{port}", tags)}
    config = write_config(tmp_path / "config.yaml", endpoint, lines)
    with station("tcp", str(port)) as plc, await asyncio.to_thread(started, config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            assert (await client.get(RECIPE, b"50"))[0].ok
            with held(gateway.pid):
                asked = asyncio.create_task(client.get(RECIPE, b"78"))
                await client.put(RECIPE, b"79")
                await asyncio.sleep(HOLD)  # the attack itself
            [reply] = await asked
            assert not reply.ok
            assert (reply.json["error"], "stood still" in reply.json["reason"]) == ("busy", True)
            assert plc.tell("get 1 D 500") == "50"
            await asyncio.to_thread(gateway.says, "gateway stood still")
            await until_taken(client, b"51")
        assert plc.tell("get 1 D 500") == "51"
        assert not any("value=79" in line and "tag written" in line for line in gateway.lines)


async def test_writes_that_waited_for_the_wire_when_the_gateway_was_held_are_refused(
    tmp_path: Path,
) -> None:
    """At most the one is done whose transaction was open."""
    endpoint, port = free_endpoint(), free_port()
    tags = {f"recipe{n}": {"address": f"D{500 + 40 * n}", "write": True} for n in range(4)}
    lines = {"hall": vigor_line(f"tcp://127.0.0.1:{port}", tags, reply_timeout="5s")}
    config = write_config(tmp_path / "config.yaml", endpoint, lines)
    with station("tcp", str(port)) as plc, await asyncio.to_thread(started, config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        plc.tell("delay 1 0.25")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            told = await client.subscribe("plant/@gateway/demo/writes")
            for name in tags:
                await client.put(f"plant/mixer/{name}/@set", b"7")
            await told.until(lambda h: bool(h.samples))
            before = len(told.samples)
            with held(gateway.pid):
                await asyncio.sleep(HOLD)
            await told.until(lambda h: len(h.samples) == len(tags))
        values = [plc.tell(f"get 1 D {500 + 40 * n}") for n in range(4)]
        assert values.count("7") <= before + 1
        ends = [sample.json["outcome"] for sample in told.samples]
        assert ends.count("busy") >= len(tags) - before - 1


class Plc:
    """A Modbus TCP device with one register. It acknowledges a first write when it may."""

    def __init__(self) -> None:
        self.value = 0
        self.written, self.acknowledges = asyncio.Event(), asyncio.Event()

    async def serve(
        self, _number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            request = await reader.readexactly(12)
            if request[7] == 3:
                reply = tcp_reply(request)
                writer.write(reply[:-2] + self.value.to_bytes(2, "big"))
                continue
            self.value = int.from_bytes(request[-2:], "big")
            self.written.set()
            await self.acknowledges.wait()
            writer.write(request)


async def test_the_woken_gateway_of_a_group_does_not_write_over_the_new_active_one(
    tmp_path: Path,
) -> None:
    router, plc = free_endpoint(), Plc()
    (tmp_path / "zenoh.json5").write_text("{transport: {link: {tx: {lease: 1000}}}}")
    secret = tmp_path / "hall.txt"
    secret.write_text("a secret of twenty or more")
    secret.chmod(0o600)
    group = {"standby": "hall", "secret_file": str(secret)}
    tags = {"recipe": {"address": "holding:7", "type": "uint16", "write": True}}
    device = {"protocol": "modbus-tcp", "station": 1, "reply_timeout": "20s", "tags": tags}
    with ExitStack() as programs:
        async with peer(plc.serve) as port, ZenohPeer("router", listen=[router]):
            files = [
                write_config(
                    tmp_path / f"{name}.yaml",
                    router,
                    {"net": {"port": f"tcp://127.0.0.1:{port}", "devices": {"mixer": device}}},
                    gateway={"name": name, **group},
                    zenoh={"listen": [], "connect": [router], "config_file": "zenoh.json5"},
                )
                for name in "ab"
            ]
            commands = [(sys.executable, "-c", RUN, "run", file) for file in files]
            async with ZenohPeer("client", connect=[router]) as client:
                a = programs.enter_context(Program(*commands[0]))
                await asyncio.to_thread(a.says, "device online")
                b = programs.enter_context(Program(*commands[1]))
                await asyncio.to_thread(b.says, "Zenoh link up")
                for value in range(70, 78):
                    await client.put(RECIPE, b"%d" % value)
                await plc.written.wait()
                with held(a.pid):
                    held_long_enough = asyncio.create_task(asyncio.sleep(LONGEST_PAUSE + 0.3))
                    plc.acknowledges.set()
                    await asyncio.to_thread(b.says, "device online")
                    while not (replies := await client.get(RECIPE, b"50")):
                        await asyncio.sleep(0.02)  # the router does not know its queryables yet
                    [reply] = replies
                    assert reply.ok
                    await held_long_enough
                await asyncio.to_thread(a.says, "gateway replaced")
                await asyncio.to_thread(a.says, "gateway starts over")
                assert plc.value == 50
