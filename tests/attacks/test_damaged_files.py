"""Small files of the gateway are damaged while it is off: a person must know before it is green."""

import json
import urllib.request
from pathlib import Path

from tests.conftest import Command
from tests.e2e.processes import free_port, started, until, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import free_endpoint

FILES = ("state.json", "state.held.json", "alarms.json", "writers.json")
TAGS = {"speed": {"address": "D10", "alarm": {"high": 80}}}


def test_each_damaged_file_is_a_fault_until_it_is_removed(command: Command, tmp_path: Path) -> None:
    """With `writers.json` the time until which signatures were accepted is lost."""
    secret(tmp_path / "writers.txt", "alice:" + "a" * 40 + "\n")
    limit = {"limit": {"address": "holding:0", "write": True}}
    panel = {"protocol": "modbus-tcp", "stale_after": "24h", "tags": limit}
    file = write_config(
        tmp_path / "plant.yaml",
        free_endpoint(),
        {
            "hall": vigor_line("simulator", TAGS),
            "panel": {
                "port": f"tcp://127.0.0.1:{free_port()}",
                "serve": True,
                "devices": {"hmi": panel},
            },
        },
        gateway={"name": "demo", "state": "state.json"},
        writers={"file": "writers.txt"},
        web={"listen": f"127.0.0.1:{(port := free_port())}"},
    )
    for name in FILES:
        (tmp_path / name).write_text("{")

    def metric() -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as reply:
            lines = reply.read().decode().splitlines()
            [line] = [one for one in lines if one.startswith("plc_gateway_faults ")]
            return str(line.split()[-1])

    def damaged() -> set[str]:
        documents = command("status", "--json", file).json
        return {Path(one).name for one in documents["damaged"]["files"]}

    asides = {f"{name}.bad" for name in FILES}
    with started(file) as program:
        until(lambda: damaged() == asides, "each file is a fault")
        done = command("status", file)
        assert done.code != 0
        assert all(f"{name} is a damaged file" in " ".join(done.out.split()) for name in asides)
        assert metric() == "4.0"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/status", timeout=60) as reply:
            assert sum("damaged file" in one for one in json.load(reply)["faults"]) == 4
        assert program.end() == 0
    for name in sorted(asides)[1:]:
        (tmp_path / name).unlink()
    with started(file):  # a restart ends no fault
        left = min(asides)
        until(lambda: damaged() == {left}, "only the file that lies there is a fault")
        (tmp_path / left).rename(tmp_path / "alarms.json.known")
        until(lambda: not damaged(), "the fault ends")
        assert metric() == "0.0"
