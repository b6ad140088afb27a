"""The log for programs: JSON on every line, whatever is said and by whom."""

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from gateway import __version__
from tests.e2e.processes import Program, plc_gateway, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The command itself. SIGUSR1 makes a library and Python complain, and a thread and a task crash.
RUN = """
import asyncio, logging, signal, threading, warnings
def crash(*_):
    raise RuntimeError("out of\\nsorts")
def complain(*_):
    warnings.warn("this will be removed")
    logging.getLogger("serialx").warning("port is %s", "odd")
    threading.Thread(target=crash).start()
    asyncio.get_running_loop().call_soon(crash)
signal.signal(signal.SIGUSR1, complain)
from gateway.cli.main import main
main()
"""


async def test_every_line_is_one_document(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    tags = {"speed": {"address": "D10"}, "recipe": {"address": "D500", "write": True}}
    lines = {"hall": vigor_line("simulator", tags)}
    file = write_config(tmp_path / "c.yaml", endpoint, lines)
    run = (sys.executable, "-c", RUN, "run", file, "--log-format", "json")
    with Program(*run) as program:
        await asyncio.to_thread(program.says, "Zenoh session ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
        async with ZenohPeer("peer", connect=[endpoint]) as client:
            await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
        await asyncio.to_thread(program.says, "Zenoh link down")
        os.kill(program.pid, signal.SIGUSR1)
        await asyncio.to_thread(program.says, "Exception in callback")
        await asyncio.to_thread(program.says, "thread crashed")
        assert await asyncio.to_thread(program.end) == 0
        log: list[dict[str, Any]] = [json.loads(line) for line in program.lines]
    assert all(entry["event"] and entry["level"] and entry["timestamp"] for entry in log)
    events = [entry["event"] for entry in log]
    first, last = log[0], log[-1]
    assert first["event"] == "gateway starting"
    assert (first["version"], first["file"]) == (__version__, str(file))
    assert (first["name"], first["lines"], first["tags"]) == ("demo", 1, 2)
    assert events.index("gateway stopping") < len(events) - 1
    assert last["event"] == "gateway stopped"
    links = [entry for entry in log if entry["event"].startswith("Zenoh link")]
    assert [(entry["to"], entry["level"]) for entry in links] == [
        ("peer", "info"),
        ("peer", "warning"),
    ]
    assert all(entry["address"].startswith("tcp/127.0.0.1:") for entry in links)
    assert [e["event"] for e in log if e.get("logger") == "serialx"] == ["port is odd"]
    assert any("this will be removed" in event for event in events)
    [crashed] = [entry for entry in log if entry["event"] == "thread crashed"]
    assert "RuntimeError: out of\nsorts" in crashed["exception"]


def test_a_mistake_in_the_file_is_a_document_too(tmp_path: Path) -> None:
    file = write_config(tmp_path / "c.yaml", free_endpoint(), {}, history={"path": 3})
    done = plc_gateway("run", file, "--log-format", "json")
    assert done.code == 2
    log = [json.loads(line) for line in done.err.splitlines()]
    assert [entry["event"] for entry in log] == ["gateway failed"] * 2
    assert any("no lines" in entry["why"] for entry in log)
