"""Whatever a stranger sends on whichever key: bounded memory, and the event loop undisturbed.

`python -m benchmarks.northbound --flood 600` does the same for longer, with 50,000 tags.
"""

import asyncio
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.northbound import Lag, memory
from gateway.northbound import ZenohSettings
from tests.test_northbound import PlainDevice, PlainPlant, serving, tag
from tests.zenoh_peer import ZenohPeer, free_endpoint

ROOT = Path(__file__).parent.parent


def plant() -> PlainPlant:
    return PlainPlant(
        *(PlainDevice(f"d{d}", tuple(tag(f"d{d}", f"t{n}") for n in range(50))) for d in range(4))
    )


async def test_a_flood_of_everything_costs_little_memory_and_no_poll() -> None:
    endpoint = free_endpoint()
    served = plant()
    async with (
        serving(served, ZenohSettings(listen=(endpoint,))) as northbound,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        await client.get("plant/**")
        before = most = memory()
        lag = Lag()
        probe = asyncio.create_task(lag.run())
        command = [sys.executable, "-m", "benchmarks.northbound", "flood", endpoint, "3"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as flood:
            while flood.poll() is None:
                northbound.publish([served.now("d0/t0", int(time.time()) % 30_000)])
                most = max(most, memory())
                await asyncio.sleep(0.05)
            assert flood.stdout is not None
            sent = int(flood.stdout.read())
        probe.cancel()
        counters = northbound.counters()
        # It did hear a good part of it, and refused what there was no room for.
        assert sent > 1000
        assert counters["queries"] > 500
        assert most - before < 150.0, f"{before:.0f} MB grew to {most:.0f} MB"
        # A line's task would have been late by as much; a stall of seconds is what must not be.
        late = sorted(lag.late)
        assert late[len(late) // 2] < 0.02
        assert late[-1] < 1.0
        assert served.written == []
        # And it answers as before.
        [reply] = await client.get("plant/d1/t1")
        assert reply.ok
