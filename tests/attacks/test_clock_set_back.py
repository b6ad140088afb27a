"""The clock of the gateway is set back ten minutes, and its link is cut: no change is missed."""

import asyncio
import os
import signal
import sys
from pathlib import Path

from tests.e2e.paced_link import paced_link
from tests.e2e.processes import ROOT, Program, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The command itself; SIGUSR1 sets its wall clock back.
RUN = """
import signal, time
real, shift = time.time_ns, [0]
time.time_ns = lambda: real() - shift[0]
signal.signal(signal.SIGUSR1, lambda *_: shift.__setitem__(0, 600 * 10**9))
from gateway.cli.main import main
main()
"""
CUT = 3.0  # seconds


async def test_a_consumer_misses_nothing_when_the_clock_is_set_back(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    tags = {"speed": {"address": "D10", "every": "50ms", "history": True}}
    file = write_config(
        tmp_path / "c.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags)},
        history={"path": "history.db"},
    )
    with Program(sys.executable, "-c", RUN, "run", file) as gateway:
        gateway.says("Zenoh session ready")
        async with (
            paced_link(endpoint) as link,
            ZenohPeer("client", connect=[endpoint]) as client,
        ):
            catch_up = ROOT / "examples" / "catch_up.py"
            at = link.endpoint
            since = "2020-01-01T00:00:00Z"
            with Program(sys.executable, catch_up, "--connect", at, "--since", since) as consumer:
                await asyncio.to_thread(consumer.says, "plant/mixer/speed")
                os.kill(gateway.pid, signal.SIGUSR1)
                until = asyncio.get_running_loop().time() + CUT
                while asyncio.get_running_loop().time() < until:
                    await link.cut()
                    await asyncio.sleep(0.05)
                replies = await client.get("plant/mixer/speed?_time=[..]", consolidation="NONE")
                recorded = [reply.json["time"] for reply in replies]
                assert recorded[0] < recorded[-1]
                for time in recorded:
                    await asyncio.to_thread(consumer.says, time)
                lines = [line.removesuffix(" late") for line in consumer.lines]
                assert len(set(lines)) == len(lines)
