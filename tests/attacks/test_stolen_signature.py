"""A program that receives a signed write cannot write with it."""

import asyncio
import json
import sys
from pathlib import Path

from tests.e2e.processes import (
    ROOT,
    Program,
    plc_gateway,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
SECRET = "Zm9vYmFyYmF6cXV4Zm9vYmFyYmF6cXV4"  # noqa: S105  (of a test)


def write_until(done: str, *command: object) -> str:
    """Runs a program that writes, as Alice, until it says that it has. Returns its output."""
    texts = []

    def runs() -> bool:
        variable = f"PLC_GATEWAY_WRITER=alice:{SECRET}"
        with Program("env", variable, sys.executable, *command) as client:
            client.ended()
        texts.append("\n".join(client.lines))
        return done in texts[-1]

    until(runs, f"it says {done}")
    return "\n".join(texts)


async def test_a_program_that_receives_a_signed_write_can_do_nothing_with_it(
    tmp_path: Path,
) -> None:
    endpoint = free_endpoint()
    file = tmp_path / "writers.txt"
    file.write_text(f"alice:{SECRET}\n")
    file.chmod(0o600)
    lines = {"hall": vigor_line("simulator", {"recipe": {"address": "D500", "write": True}})}
    config = write_config(tmp_path / "plant.yaml", endpoint, lines, writers={"file": str(file)})
    checked = await asyncio.to_thread(plc_gateway, "check", config)
    assert (checked.code, "warning: `writers` without access_control" in checked.err) == (0, True)
    with await asyncio.to_thread(started, config) as gateway:
        assert gateway.has_said("Zenoh session exposed", "`writers` without access_control")
        async with ZenohPeer("client", connect=[endpoint]) as thief:
            stolen = await thief.queryable(RECIPE)
            example = (ROOT / "examples" / "signed_write.py", "plant/mixer/recipe", "7")
            own = ("-m", "gateway", "write", config, "mixer/recipe", "8")
            # A signature from before the start is refused, or one of about that time.
            for text in await asyncio.gather(
                asyncio.to_thread(write_until, '"value":7', *example, "--connect", endpoint),
                asyncio.to_thread(write_until, "acknowledged", *own),
            ):
                assert SECRET not in text
            taken = [sample for sample in stolen.samples if sample.attachment]
            assert {"7", "8"} <= {sample.payload.decode() for sample in taken}
            for sample in taken:
                assert SECRET.encode() not in sample.payload + sample.attachment
                assert set(json.loads(sample.attachment)) == {"by", "time", "nonce", "signature"}
                for value in (sample.payload, b"78"):
                    [reply] = await thief.get(RECIPE, value, attachment=sample.attachment)
                    assert reply.json["error"] in ("not-allowed", "unclear")
            [reply] = await thief.get("plant/mixer/recipe?max_age=0s")
            assert reply.json["value"] in (7, 8)
