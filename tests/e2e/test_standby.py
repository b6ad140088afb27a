"""Two gateways of a group: one at most uses the wire, and one does soon after a crash."""

import asyncio
import json
import signal
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import ExitStack, asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.e2e.processes import Program, free_port, slowed, station
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The command itself; only the longest wait is shorter, so that the suite is.
RUN = """
import sys
import gateway.northbound.group.election as election
election.SETTLE_TIME = float(sys.argv.pop(1))
from gateway.cli.main import main
main()
"""
SETTLE_TIME, CLAIM_TIME = 2.0, 1.5


class Wire:
    """A device server without a PLC that counts its connections."""

    def __init__(self) -> None:
        self.open = 0
        self.most = 0
        self.changed = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._now(self.open + 1)
        while await reader.read(4096):
            pass
        self._now(self.open - 1)
        writer.close()

    def _now(self, count: int) -> None:
        self.open = count
        self.most = max(self.most, count)
        self.changed.set()

    async def until(self, count: int, within: float) -> None:
        """Waits until the number of connections is `count`."""
        async with asyncio.timeout(slowed(within)):
            while self.open != count:
                self.changed.clear()
                await self.changed.wait()


@asynccontextmanager
async def wire() -> AsyncIterator[tuple[Wire, int]]:
    line, port = Wire(), free_port()
    async with await asyncio.start_server(line.serve, "127.0.0.1", port) as server:
        yield line, port
        server.close()


def gateway(
    folder: Path,
    name: str,
    router: str,
    port: int,
    listen: Sequence[str] = (),
    settle: float = SETTLE_TIME,
) -> Program:
    """`router`: where it connects to; empty for a gateway that only listens."""
    tags = {"speed": {"address": "D100"}, "run": {"address": "Y20", "write": True}}
    device = {"protocol": "vigor", "station": 1, "tags": tags}
    line = {"port": f"tcp://127.0.0.1:{port}", "baudrate": 19200, "devices": {"mixer": device}}
    text = {
        "gateway": {"name": name, "standby": "hall"},
        "zenoh": {"listen": list(listen), "connect": [router] if router else []},
        "lines": {"hall-1": line},
    }
    file = folder / f"{name}.yaml"
    file.write_text(json.dumps(text))
    return Program(sys.executable, "-c", RUN, settle, "run", file)


async def until_states(client: ZenohPeer, **stands: str) -> None:
    """Waits until these gateways, and no others, report these states, and the active one sees who
    waits. Their documents lag a little."""
    waiting = [name for name, stand in stands.items() if stand == "waiting"]
    async with asyncio.timeout(300):
        while True:
            replies = await client.get("plant/@gateway/*/standby")
            found = {str(reply.key).split("/")[2]: reply.json for reply in replies if reply.key}
            if {name: one["stand"] for name, one in found.items()} == stands:
                active = next(one for one in found.values() if one["stand"] == "active")
                if active["others_waiting"] == waiting:
                    return


async def test_two_gateways_of_a_group_share_one_wire(tmp_path: Path) -> None:
    router_at = free_endpoint()
    with ExitStack() as programs:
        async with wire() as (line, port), ZenohPeer("router", listen=[router_at]) as router:
            b = programs.enter_context(gateway(tmp_path, "b", router_at, port))
            a = programs.enter_context(gateway(tmp_path, "a", router_at, port))
            async with ZenohPeer("client", connect=[router_at]) as client:
                # Both start at once: the first by name goes.
                await line.until(1, within=15)
                await until_states(client, a="active", b="waiting")
                # One answers for the plant, and takes its writes; both say that they are there.
                replies = await client.get("plant/mixer/speed", consolidation="NONE")
                assert len(replies) == 1
                assert len(await client.get("plant/mixer/run/@set", b"true", target="ALL")) == 1
                await client.until_alive("plant/@gateway/*", [f"plant/@gateway/{n}" for n in "ab"])
                # The network is lost and comes back: both keep their states.
                await router.kill()
                async with ZenohPeer("router", listen=[router_at]):
                    await asyncio.sleep(SETTLE_TIME + CLAIM_TIME + 1)
                    await until_states(client, a="active", b="waiting")
                    assert (line.open, line.most) == (1, 1)
                    # A crash. The values of the next one are later than those of the first.
                    values = await client.subscribe("plant/mixer/speed")
                    crashed = datetime.now(UTC).isoformat()
                    await asyncio.to_thread(a.end, signal.SIGKILL)
                    await line.until(0, within=1)
                    await line.until(1, within=3)
                    next_one = await values.next(lambda s: s.json["reason"] == "starting")
                    assert next_one.json["time"] > crashed
                    await until_states(client, b="active")
                    # The gateway that comes back is standby until the other one ends.
                    a = programs.enter_context(gateway(tmp_path, "a", router_at, port))
                    await until_states(client, a="waiting", b="active")
                    await asyncio.sleep(CLAIM_TIME + 1)
                    await until_states(client, a="waiting", b="active")
                    assert await asyncio.to_thread(b.end) == 0
                    await line.until(1, within=3)
                    assert line.most == 1
                    assert await asyncio.to_thread(a.end) == 0


async def says(program: Program, *words: str, after: int = 0) -> int:
    """Returns the number of lines up to the one with the words, after so many."""
    line = await asyncio.to_thread(program.says, *words, after=after)
    return program.lines.index(line, after) + 1


@pytest.mark.parametrize("watched", ["a", "b"])
async def test_watch_continues_with_the_active_gateway_of_the_group(
    tmp_path: Path, watched: str
) -> None:
    """With the file of either of them. When both are gone all values are bad at once."""
    router_at, port, good, gone = free_endpoint(), free_port(), '"good"', '"no-gateway"'
    with ExitStack() as programs:
        programs.enter_context(station("tcp", str(port)))
        async with ZenohPeer("router", listen=[router_at]):
            a = programs.enter_context(gateway(tmp_path, "a", router_at, port))
            await says(a, "device online")
            b = programs.enter_context(gateway(tmp_path, "b", router_at, port))
            file = tmp_path / f"{watched}.yaml"
            watch = programs.enter_context(
                Program(sys.executable, "-m", "gateway", "watch", file, "mixer/speed", "--json")
            )
            seen = await says(watch, good)
            a.end(signal.SIGKILL)
            seen = await says(watch, gone, after=seen)
            seen = await says(watch, good, after=seen)
            b.end(signal.SIGKILL)
            await says(watch, gone, after=seen)


async def test_a_router_that_visited_does_not_disable_the_standby(tmp_path: Path) -> None:
    """The gateways are linked to each other. A router linked to one of them for a moment."""
    endpoint, port = free_endpoint(), free_port()
    with ExitStack() as programs:
        programs.enter_context(station("tcp", str(port)))
        # So long b waits for a: on a busy machine a starts late.
        b = programs.enter_context(gateway(tmp_path, "b", "", port, [endpoint], settle=10))
        a = programs.enter_context(gateway(tmp_path, "a", endpoint, port))
        await says(a, "device online")
        async with ZenohPeer("router", connect=[endpoint]):
            await says(b, "Zenoh link up", "to=router")
        await says(b, "Zenoh link down", "to=router")
        a.end(signal.SIGKILL)
        await says(b, "device online")
