"""The event loop of the gateway stands still, while its other threads go on."""

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from tests.e2e.processes import Program, vigor_line, write_config
from tests.zenoh_peer import Received, ZenohPeer, free_endpoint

# The command itself, with shorter times. SIGUSR1 holds the thread of the loop until a line comes
# from standard input.
RUN = """
import signal, sys
import gateway.northbound.group.election as election
import gateway.northbound.session.watchdog as watchdog
election.SETTLE_TIME = election.CLAIM_TIME = 0.3
watchdog.LIMIT = 1.5
signal.signal(signal.SIGUSR1, lambda *_: print("ok", sys.stdin.readline(), flush=True))
from gateway.cli.main import main
main()
"""
# The gateway's own, that of its device, and its sign for the standby.
TOKENS = "@gateway/demo", "@gateway/demo/alive/mixer", "@standby/hall/active/demo/*"


def is_kind(kind: str) -> Callable[[Received], bool]:
    return lambda sample: sample.kind == kind


async def test_all_tokens_end_while_the_loop_stands_still_and_the_gateway_starts_over(
    tmp_path: Path,
) -> None:
    router = free_endpoint()
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    file = write_config(
        tmp_path / "c.yaml",
        router,
        lines,
        gateway={"name": "demo", "standby": "hall"},
        zenoh={"prefix": "plant", "listen": [], "connect": [router]},
    )
    async with (
        ZenohPeer("router", listen=[router]),
        ZenohPeer("client", connect=[router]) as client,
    ):
        with Program(sys.executable, "-c", RUN, "run", file) as gateway:
            live = [await client.liveliness(f"plant/{key}") for key in TOKENS]
            for token in live:
                await token.next(is_kind("PUT"))
            await asyncio.to_thread(gateway.says, "Zenoh session ready")
            os.kill(gateway.pid, signal.SIGUSR1)
            for token in live:
                await token.next(is_kind("DELETE"))
                token.forget()
            await asyncio.to_thread(gateway.tell, "go on")
            await asyncio.to_thread(gateway.says, "event loop stood still")
            await asyncio.to_thread(gateway.says, "gateway starts over")
            for token in live:
                await token.next(is_kind("PUT"))
            values = await client.subscribe("plant/mixer/speed")
            await values.next(lambda sample: sample.json["quality"] == "good")
            assert not gateway.has_said("Traceback")
