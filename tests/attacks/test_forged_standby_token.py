"""A program that declares the token of another gateway does not take a gateway off the wire."""

import asyncio
import sys
from pathlib import Path

from tests.e2e.processes import Program, plc_gateway, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The command itself; only the longest wait is shorter, so that the suite is.
RUN = """
import gateway.northbound.group.election as election
election.SETTLE_TIME = 0.5
from gateway.cli.main import main
main()
"""


async def test_a_forged_token_is_refused_and_the_gateway_goes_on(tmp_path: Path) -> None:
    endpoint, secret = free_endpoint(), tmp_path / "hall.txt"
    secret.write_text("a secret of twenty or more\n")
    secret.chmod(0o600)
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    group = {"name": "b", "standby": "hall"}
    config = write_config(
        tmp_path / "b.yaml",
        endpoint,
        lines,
        gateway={**group, "secret_file": str(secret)},
    )
    with Program(sys.executable, "-c", RUN, "run", config) as gateway:
        await asyncio.to_thread(gateway.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            for role in ("claim", "active"):
                await client.declare_token(f"plant/@standby/hall/{role}/a/f00d")
                await asyncio.to_thread(gateway.says, "standby token refused", f"{role}/a/f00d")
            for _ in range(10):  # longer than a decision of the election takes
                [reply] = await client.get("plant/mixer/speed?max_age=0s")
                assert reply.json["quality"] == "good"
            [standby] = await client.get("plant/@gateway/b/standby")
            assert (standby.json["stand"], standby.json["others_active"]) == ("active", [])
        assert not gateway.has_said("gateway replaced")
        assert not gateway.has_said("secret_file")
    unsigned = write_config(tmp_path / "open.yaml", endpoint, lines, gateway=group)
    checked = await asyncio.to_thread(plc_gateway, "check", unsigned)
    assert checked.code == 0
    assert "warning: `standby` without `secret_file`" in checked.err
