"""A gateway of a standby group is replaced again and again: its memory does not grow."""

import sys
from pathlib import Path

from tests.e2e.processes import Program, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

# The service itself. Each of its gateways is replaced as soon as it is on Zenoh.
RUN = """
import asyncio, sys, weakref
from pathlib import Path
from gateway.service import service
from gateway.plant.plant import Plant
from gateway.config import load

made = []

def make(*arguments, **named):
    print("alive", sum(one() is not None for one in made), "of", len(made), flush=True)
    gateway = Plant(*arguments, **named)
    made.append(weakref.ref(gateway))
    return gateway

async def serve(file, withheld, stop, started, supervisor):
    on_zenoh = asyncio.Event()
    await inner(file, withheld, on_zenoh, on_zenoh.set, supervisor)
    return {} if len(made) < 4 else None

inner, service._serve, service.Plant = service._serve, serve, make
asyncio.run(service.run(load(file := Path(sys.argv[1])), file))
"""


def test_a_replaced_gateway_is_freed(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    file = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with Program(sys.executable, "-c", RUN, file) as service:
        assert service.ended() == 0
        alive = [line.split()[1] for line in service.lines if line.startswith("alive")]
        assert len(alive) == 4
        assert set(alive) <= {"0", "1"}  # of the last one some callbacks may still wait
