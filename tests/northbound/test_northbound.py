"""The life of the session: liveliness tokens, a killed process, an orderly end."""

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from gateway.config import ZenohConfig, ZenohMode
from gateway.errors import (
    ConfigError,
    GatewayError,
)
from tests.e2e.processes import slowed
from tests.northbound.plant import (
    gateway_and_client,
    mixer,
    northbound_of,
    serving,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint


async def test_liveliness_shows_gateway_and_devices() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (northbound, client):
        live = await client.liveliness("plant/@gateway/*/alive/**")
        northbound.set_online("mixer", True)
        await live.next(
            lambda token: (token.key, token.kind) == ("plant/@gateway/demo/alive/mixer", "PUT")
        )
        await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
        await client.until_alive("plant/@gateway/*/alive/*", ["plant/@gateway/demo/alive/mixer"])
        northbound.set_online("mixer", False)
        await live.next(
            lambda token: (token.key, token.kind) == ("plant/@gateway/demo/alive/mixer", "DELETE")
        )
        await client.until_alive("plant/@gateway/*/alive/*", [])


async def gateway_process(endpoint: str, fails: str = "") -> asyncio.subprocess.Process:
    """This file run as a gateway of its own, already serving."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.northbound.test_northbound",
        endpoint,
        fails,
        cwd=Path(__file__).parents[2],
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    async with asyncio.timeout(300):
        while b"serving" not in await process.stdout.readline():
            pass
    return process


async def test_the_token_of_a_killed_gateway_ends_within_its_lease() -> None:
    endpoint = free_endpoint()
    async with (
        ZenohPeer("router", listen=[endpoint]),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        live = await client.liveliness("plant/@gateway/*")
        process = await gateway_process(endpoint)
        await live.next(lambda token: token.kind == "PUT")
        process.kill()
        await live.next(lambda token: token.kind == "DELETE", timeout=slowed(3.0))
        await process.communicate()


@pytest.mark.parametrize("fails", ["loop", "interrupt"])
async def test_a_failing_process_closes_the_session_and_ends(fails: str) -> None:
    endpoint = free_endpoint()
    async with ZenohPeer("router", listen=[endpoint]):
        process = await gateway_process(endpoint, fails)
        async with asyncio.timeout(slowed(4)):
            _, errors = await process.communicate()
        assert process.returncode == 1
        assert (b"the loop went wrong" in errors) == (fails == "loop")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"listen": ("127.0.0.1:7447",)}, "zenoh listen '127.0.0.1:7447'"),
        ({"connect": ("tcp/router",)}, "write it as tcp/host:port"),
        ({"connect": ("tcp/router:99999",)}, "write it as tcp/host:port"),
        ({"connect": ("serial/x:1",)}, "serial is none of tcp"),
        ({"mode": ZenohMode.CLIENT}, "name its router"),
        ({"prefix": "plant/**"}, "the prefix 'plant/\\*\\*'"),
        ({"config_file": Path("/nowhere/zenoh.json5")}, "No such file"),
    ],
)
def test_a_mistake_in_the_settings_is_one_sentence(settings: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        northbound_of(mixer(), ZenohConfig(**settings))


def no_plant() -> Any:
    return None  # never used: the settings are checked first


async def test_a_port_in_use_is_one_sentence_and_ends_the_run() -> None:
    endpoint = free_endpoint()
    async with serving(mixer(), ZenohConfig(listen=(endpoint,))):
        with pytest.raises(GatewayError, match=r"Zenoh cannot be opened: .*"):
            await northbound_of(mixer(), ZenohConfig(listen=(endpoint,)), name="second").run()


async def serve(endpoint: str, fails: str) -> None:
    async with serving(mixer(), ZenohConfig(connect=(endpoint,))):
        print("serving", flush=True)
        if fails == "loop":
            await asyncio.sleep(0.2)
            raise RuntimeError("the loop went wrong")
        if fails == "interrupt":
            asyncio.get_running_loop().call_later(0.2, os.kill, os.getpid(), signal.SIGINT)
        await asyncio.Event().wait()


if __name__ == "__main__":
    try:
        asyncio.run(serve(sys.argv[1], sys.argv[2]))
    except KeyboardInterrupt:
        sys.exit(1)
