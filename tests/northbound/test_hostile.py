"""A flood of messages on all keys: bounded memory, and an undisturbed event loop.

`python -m benchmarks.northbound --flood 600` does the same for longer, with 50,000 tags, and prints
the rate of the queries.
"""

import asyncio
import json
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

from benchmarks.northbound import memory
from benchmarks.northbound_clients import Lag
from gateway.config import ZenohConfig
from tests.e2e.processes import slowed
from tests.northbound.plant import PlainDevice, PlainPlant, serving, tag
from tests.zenoh_peer import ZenohPeer, free_endpoint

# One client with everything on every key, two with queries alone: 10,000 a second and more.
KINDS = ("flood", "ask", "ask")
SECONDS = "3"
ROOT = Path(__file__).parents[2]


def plant() -> PlainPlant:
    return PlainPlant(
        *(PlainDevice(f"d{d}", tuple(tag(f"d{d}", f"t{n}") for n in range(50))) for d in range(4))
    )


def other(*arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "benchmarks.northbound_clients", *arguments, SECONDS]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)


async def test_a_flood_of_everything_costs_little_memory_and_no_poll() -> None:
    endpoint = free_endpoint()
    served = plant()
    async with (
        serving(served, ZenohConfig(listen=(endpoint,))) as northbound,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        await client.get("plant/**")
        before = most = memory()
        lag = Lag()
        probe = asyncio.create_task(lag.run())
        with ExitStack() as stack:
            clients = [stack.enter_context(other(kind, endpoint)) for kind in KINDS]
            idler = stack.enter_context(other("idle"))
            while any(one.poll() is None for one in clients):
                northbound.publish([served.now("d0/t0", int(time.time()) % 30_000)])
                most = max(most, memory())
                await asyncio.sleep(0.05)
            *results, idle = [p.stdout.read() for p in (*clients, idler) if p.stdout is not None]
        probe.cancel()
        counters = northbound.counters()
        # It received many of them, and refused those beyond its limits.
        assert int(results[0]) > 0
        assert counters["queries"] > 0
        # Each query ended with an answer or an error.
        ended: Counter[str] = Counter()
        for result in map(json.loads, results[1:]):
            assert sum(result["ended"].values()) == result["asked"]
            ended += Counter(result["ended"])
        assert ended["answered"] > 0
        assert ended["an error"] > 0
        assert not ended["silent"]
        assert most - before < 150.0, f"{before:.0f} MB grew to {most:.0f} MB"
        # A line's task would have been as late. On a busy machine the loop of an idle process is
        # late too.
        late, idlers = sorted(lag.late), json.loads(idle)
        assert late[len(late) // 2] < 0.02 + 5 * idlers[len(idlers) // 2]
        assert late[-1] < slowed(1.0) + 5 * idlers[-1]
        assert served.written == []
        # Afterwards it answers as before.
        [reply] = await client.get("plant/d1/t1")
        assert reply.ok
