"""Two gateways behind a router with the rules of docs/access-control.md, and an attacker."""

import asyncio
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.attacks.security_pages import client, quoted, table, user_of
from tests.attacks.test_security_writers import Writer
from tests.e2e.processes import Program, started, vigor_line, write_config
from tests.northbound.access import PASSWORDS, ROUTER_RULES, secret, users
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
ALICE = f"alice:{'a' * 40}"
# The command itself; the waits of the election are shorter, so that the suite is.
RUN = """
import gateway.northbound.group.election as election
election.SETTLE_TIME, election.CLAIM_TIME = 0.3, 0.8
from gateway.cli.main import main
main()
"""
BEYOND_A_GATEWAY = int(table("Limits")[0][1].split()[0]) * 1024 + 1


def as_user(name: str, endpoint: str) -> ZenohPeer:
    return client(endpoint, user_of(name, PASSWORDS[name]))


@contextmanager
def router(folder: Path) -> Iterator[str]:
    """A gateway in mode `router` without tags."""
    endpoint = free_endpoint()
    (folder / "access.json5").write_text(ROUTER_RULES)
    settings = {
        "mode": "router",
        "prefix": "other",
        "listen": [endpoint],
        "users_file": users(folder).name,
        "config_file": "access.json5",
    }
    lines = {"hall": vigor_line("simulator", {})}
    with started(write_config(folder / "router.yaml", "", lines, zenoh=settings)):
        yield endpoint


async def test_a_gateway_that_becomes_active_accepts_no_signature_from_before(
    tmp_path: Path,
) -> None:
    """The rules of a router let a standby group work, and keep others out of its election."""
    quoted("A gateway that starts or becomes active accepts no signature from before.")
    with router(tmp_path) as endpoint:
        secret(tmp_path / "writers.txt", ALICE)
        secret(tmp_path / "password.txt", PASSWORDS["gateway"])
        own = {"listen": [], "connect": [endpoint], "user": "gateway"}
        tags = {"recipe": {"address": "D500", "write": True}}
        left_file, right_file = (
            write_config(
                tmp_path / f"{name}.yaml",
                "",
                {"hall": vigor_line("simulator", tags)},
                gateway={"name": name, "standby": "hall"},
                zenoh={**own, "password_file": "password.txt"},
                writers={"file": "writers.txt"},
            )
            for name in ("left", "right")
        )
        command = (sys.executable, "-c", RUN, "run")
        with Program(*command, left_file) as left:
            await asyncio.to_thread(left.says, "Zenoh session ready")
            with Program(*command, right_file) as right:
                async with (
                    as_user("operator", endpoint) as peer,
                    as_user("gateway", endpoint) as another_gateway,
                    as_user("viewer", endpoint) as viewer,
                ):
                    tokens = [f"plant/@gateway/{name}" for name in ("left", "right")]
                    await viewer.until_alive("plant/@gateway/*", tokens)
                    for role in ("claim", "active"):
                        await peer.declare_token(f"plant/@standby/hall/{role}/a/f00d")
                    # A router forwards what a gateway would drop.
                    quoted("A router drops messages above Zenoh's own limit instead")
                    long = await viewer.subscribe("plant/**")
                    await another_gateway.put("plant/long/text", b"7" * BEYOND_A_GATEWAY)
                    await long.next(lambda sample: len(sample.payload) == BEYOND_A_GATEWAY)
                    alice = Writer(peer, ALICE)
                    await alice.until("ok")
                    stolen = alice.signed(b"9")
                    assert await alice.says(b"9", stolen) == "ok"
                    left.end(signal.SIGKILL)
                    await asyncio.to_thread(right.says, "Zenoh session ready")
                    assert await alice.says(b"9", stolen) == "not-allowed"
                    await alice.until("ok")
                for program in (left, right):
                    assert not program.has_said("gateway replaced")
