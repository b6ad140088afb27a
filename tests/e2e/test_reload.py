"""A file that is reloaded: what a client of the running program sees."""

import asyncio
import json
import os
import signal
from pathlib import Path
from typing import Any

from tests.e2e.processes import gateway, plc_gateway, started, until, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint


def lines(tags: dict[str, Any], **mixer: Any) -> dict[str, Any]:
    hall = vigor_line("simulator", tags, **mixer)
    hall["devices"]["oven"] = {
        "protocol": "vigor",
        "station": 2,
        "tags": {"heat": {"address": "D7", "write": True}},
    }
    return {"hall": hall}


async def test_clients_see_a_reload_and_a_bad_file_changes_nothing(tmp_path: Path) -> None:
    endpoint, file = free_endpoint(), tmp_path / "c.yaml"
    level, recipe = {"address": "D10"}, {"address": "D500", "write": True}
    watched = {"name": "demo", "watch_config": True}
    write_config(file, endpoint, lines({"level": level, "recipe": recipe}))
    program = started(file)
    with program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            tokens = await client.liveliness("plant/@gateway/*/alive/*")
            alive = await client.get("plant/*/*")
            assert {reply.key for reply in alive} == {
                *("plant/mixer/level", "plant/mixer/recipe", "plant/oven/heat")
            }
            gone = await client.subscribe("plant/mixer/recipe")
            new = await client.subscribe("plant/pump/flow")

            # A tag is removed, a device is added, blocks are published, the file is watched.
            changed = lines({"level": level}, blocks=True)
            changed["yard"] = vigor_line("simulator", {"flow": {"address": "D3"}})
            changed["yard"]["devices"] = {"pump": changed["yard"]["devices"].pop("mixer")}
            write_config(file, endpoint, changed, gateway=watched)
            os.kill(program.pid, signal.SIGHUP)
            last = await gone.next(lambda s: s.json.get("reason") == "disabled")
            assert last.json["detail"] == "removed from the file"
            await new.next(lambda s: s.json["quality"] == "good")
            await tokens.next(lambda s: s.key == "plant/@gateway/demo/alive/pump")
            await asyncio.to_thread(program.says, "file reloaded", "removed=[]", "added=['pump']")
            metas = await client.get("plant/**/@meta")
            assert {str(reply.key).removesuffix("/@meta") for reply in metas} == {
                *("plant/mixer/level", "plant/oven/heat", "plant/pump/flow")
            }
            [block] = await client.get("plant/mixer/@block")
            assert "level" in block.json
            [claim] = await client.get("plant/@gateway/demo/claim/*")
            assert claim.json["devices"] == ["mixer", "oven", "pump"]
            [refused] = await client.get("plant/mixer/recipe/@set", b"7")
            assert refused.json["error"] == "unknown-tag"
            [written] = await client.get("plant/oven/heat/@set", b"7")
            assert written.json["value"] == 7

            # The next content is bad: nothing changes, and the status says why.
            text = file.read_text()
            file.write_text(text.replace("D3", "D99999"))
            await asyncio.to_thread(program.says, "file refused", "yard", "flow", "D99999")
            status = await asyncio.to_thread(plc_gateway, "status", file)
            assert (status.code, "D99999" in status.out) == (0, True)
            [document] = await client.get("plant/@gateway/demo/reload")
            assert (document.json["reloads"], len(document.json["why"])) == (1, 1)

            # It is good again, and the device goes: watched, no signal.
            shorter = json.loads(text)
            del shorter["lines"]["yard"]
            file.write_text(json.dumps(shorter))
            await tokens.next(
                lambda s: (s.key, s.kind) == ("plant/@gateway/demo/alive/pump", "DELETE")
            )
            await asyncio.to_thread(program.says, "file reloaded", "removed=['pump']")
            [claim] = await client.get("plant/@gateway/demo/claim/*")
            assert claim.json["devices"] == ["mixer", "oven"]
        assert await asyncio.to_thread(program.end) == 0


def test_a_signal_to_reload_during_the_start_ends_nothing(tmp_path: Path) -> None:
    """systemd takes an end by SIGHUP for one that somebody wanted, and starts nothing again."""
    tags = {"level": {"address": "D10"}}
    file = write_config(tmp_path / "c.yaml", free_endpoint(), lines(tags))
    with gateway("run", file) as program:
        status = Path(f"/proc/{program.pid}/status")
        mask = 1 << signal.SIGHUP - 1
        until(lambda: int(_field(status, "SigBlk"), 16) & mask != 0, "the command begins")
        os.kill(program.pid, signal.SIGHUP)
        program.says("Zenoh session ready")
        program.says("file reloaded")
        assert program.end() == 0


def _field(status: Path, name: str) -> str:
    return status.read_text().partition(f"{name}:")[2].split()[0]
