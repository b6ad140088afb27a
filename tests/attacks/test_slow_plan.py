"""A plan that takes minutes holds up its own line only: not other lines, queries, or the end."""

import asyncio
import sys
from pathlib import Path
from typing import Any

from tests.e2e.processes import Program, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The service itself. The plan of line `vast` ends when a line arrives on standard input.
RUN = """
import asyncio, sys
from pathlib import Path
from gateway.service import (service)
from gateway.plant.plant import Plant
from gateway.config import load
from gateway.line.line import Line

def plan(line):
    if line.engine.name == "vast":
        print("planning", flush=True)
        sys.stdin.readline()
        print("ok", flush=True)
    return usual(line)

async def run(line):
    print("running", line.engine.name, flush=True)
    await usual_run(line)

usual, Plant.plan = Plant.plan, staticmethod(plan)
usual_run, Line.run = Line.run, run
asyncio.run(service.run(load(file := Path(sys.argv[1])), file))
"""


def _plant(folder: Path) -> tuple[Path, str]:
    """Returns the file, and the endpoint. The slow plan is neither the first nor the last."""
    lines: dict[str, Any] = {}
    for name in ("first", "vast", "last"):
        line = vigor_line("simulator", {"speed": {"address": "D10"}})
        lines[name] = {**line, "devices": {f"{name}-plc": line["devices"]["mixer"]}}
    endpoint = free_endpoint()
    return write_config(folder / "config.yaml", endpoint, lines), endpoint


async def test_lines_run_as_soon_as_they_are_planned(tmp_path: Path) -> None:
    path, endpoint = _plant(tmp_path)
    with Program(sys.executable, "-c", RUN, path) as service:
        service.says("Zenoh session ready")
        service.says("planning")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe("plant/*/speed")
            await heard.next(lambda s: s.key == "plant/first-plc/speed" and s.json["value"])
            [waiting] = await client.get("plant/vast-plc/speed")
            assert waiting.json["reason"] == "starting"
            [status] = await client.get("plant/@gateway/demo/status")
            assert status.json["lines"] == {"first": True, "vast": False, "last": False}
            assert not service.has_said("running vast")
            assert not service.has_said("running last")  # plans are made one after another
            await asyncio.to_thread(service.tell, "go on")
            await heard.next(lambda s: s.key == "plant/vast-plc/speed" and s.json["value"])
            await heard.next(lambda s: s.key == "plant/last-plc/speed" and s.json["value"])
        assert await asyncio.to_thread(service.end) == 0


def test_a_plan_does_not_hold_up_the_end(tmp_path: Path) -> None:
    path, _ = _plant(tmp_path)
    with Program(sys.executable, "-c", RUN, path) as service:
        service.says("Zenoh session ready")
        service.says("planning")
        assert service.end() == 0
        assert not service.has_said("ok")
