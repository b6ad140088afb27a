"""Transfers of the running program: values, status, outcomes, and a reload."""

import asyncio
import json
import os
import signal
from pathlib import Path
from typing import Any

from gateway.cli.status import view
from gateway.cli.terminal import out
from gateway.config import load
from gateway.parts.transfers.forecast import forecasts
from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

OWN = "plant/@gateway/demo"


def lines() -> dict[str, Any]:
    tags = {"speed": {"address": "D10", "write": True, "scale": 0.1}}
    # The turnaround is not measured: as `check` has it. A busy machine stops for longer than 0.2 s.
    hall = vigor_line("simulator", tags, turnaround="5ms", reply_timeout="2s")
    hall["devices"]["oven"] = {
        "protocol": "vigor",
        "station": 2,
        "turnaround": "5ms",
        "reply_timeout": "2s",
        "tags": {
            "setpoint": {"address": "D7", "write": {"min": 0, "max": 5000}},
            "lamp": {"address": "M3", "write": True},
        },
    }
    return {"hall": hall}


def load_of(file: Path) -> float:
    """Returns the load of the line that `check` prints."""
    [line] = forecasts(load(file))
    return round(line.load, 4)


async def test_a_value_is_carried_and_its_row_goes_on_over_a_reload(tmp_path: Path) -> None:
    endpoint, file = free_endpoint(), tmp_path / "c.yaml"
    first = {"from": "mixer/speed", "to": "oven/setpoint", "scale": 10, "stale": "1h"}
    write_config(file, endpoint, lines(), transfers=[first])
    program = started(file)
    with program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            values = await client.subscribe("plant/oven/setpoint")
            outcomes = await client.subscribe(f"{OWN}/writes")
            [written] = await client.get("plant/mixer/speed/@set", b"12.5")
            assert written.json["value"] == 12.5
            await values.next(lambda s: s.json["value"] == 125)
            mine = await outcomes.next(lambda s: s.json["by"] == "transfer 1")
            assert (mine.json["outcome"], mine.key) == ("written", f"{OWN}/writes")

            # More than the target takes: nothing is sent, and the row says so.
            await client.get("plant/mixer/speed/@set", b"900")
            bad = await outcomes.next(lambda s: s.json["outcome"] == "bad-value")
            assert (bad.json["by"], bad.json["value"]) == ("transfer 1", 9000)
            [row] = await client.get(f"{OWN}/transfers/1")
            assert (row.json["state"], row.json["code"]) == ("refused", None)
            assert (row.json["value"], row.json["refused"]) == (125, 1)
            assert "9000" in row.json["why"]
            assert row.json["last_carried"] < 60
            [line] = await client.get(f"{OWN}/lines/hall")
            first_load = line.json["expected"]["load"]
            assert first_load == load_of(file)

            # A row is put in front: the row of before has another number, and writes nothing new.
            lamp = {"from": "oven/lamp", "to": "mixer/run", "every": "200ms"}
            changed = lines()
            changed["hall"]["devices"]["mixer"]["tags"]["run"] = {"address": "Y0", "write": True}
            write_config(file, endpoint, changed, transfers=[lamp, first])
            os.kill(program.pid, signal.SIGHUP)
            await asyncio.to_thread(program.says, "file reloaded")
            await outcomes.next(lambda s: s.json["key"] == "plant/mixer/run")
            await client.get_until(f"{OWN}/transfers/1", lambda row: row["state"] == "carried")
            documents = {
                str(reply.key).removeprefix(f"{OWN}/"): reply.json
                for reply in await client.get(f"{OWN}/**")
                if not str(reply.key).endswith(("trace", "writes"))
            }
            known = documents["transfers/2"]
            assert (known["state"], known["refused"], known["value"]) == ("refused", 1, 125)
            assert documents["transfers/1"]["state"] == "carried"
            assert documents["transfers/1"]["when"] == "every 0.2 s"
            assert documents["lines/hall"]["expected"]["load"] == load_of(file) > first_load
            with out.capture() as shown:
                out.print(view(documents, None))
            text = shown.get()
            assert "transfer 2 (mixer/speed to oven/setpoint) is refused" in " ".join(text.split())

            # A loop is refused, and all goes on.
            back = {"from": "oven/setpoint", "to": "mixer/speed"}
            write_config(file, endpoint, changed, transfers=[lamp, first, back])
            os.kill(program.pid, signal.SIGHUP)
            await asyncio.to_thread(program.says, "file refused", "transfers[2]", "a loop")
            assert json.loads(file.read_text())["transfers"][2] == back
