"""The configuration of the session."""

import asyncio
import json
from pathlib import Path

import pytest

from gateway.config import ZenohConfig, ZenohMode
from gateway.errors import (
    ConfigError,
)
from gateway.northbound.session.session import open_session, visitor
from gateway.northbound.session.session_settings import configure
from gateway.plant.threads import off_loop
from tests.zenoh_peer import ZenohPeer, free_endpoint


def test_the_visitor_after_a_lost_router_reaches_the_gateway_itself(tmp_path: Path) -> None:
    users = tmp_path / "users.txt"
    users.write_text("ana:secret\nbob:other\n")
    users.chmod(0o600)
    settings = ZenohConfig(
        listen=("tcp/0.0.0.0:7447",), connect=("tcp/10.0.0.1:7447",), users_file=users
    )
    found = visitor(configure(settings))
    seen = {
        name: json.loads(found.get_json(name))
        for name in ("mode", "listen/endpoints", "connect/endpoints", "transport/auth/usrpwd/user")
    }
    assert list(seen.values()) == ["peer", [], ["tcp/127.0.0.1:7447"], "ana"]
    assert found.get_json("transport/auth/usrpwd/dictionary_file") == "null"


def test_the_settings_override_the_zenoh_file(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        """{
          mode: "client",  // comments are allowed
          connect: {endpoints: ["tcp/10.0.0.1:7447"]},
          listen: {endpoints: ["tcp/127.0.0.1:7000"]},
          transport: {link: {tx: {lease: 5000}}},
        }"""
    )
    config = configure(ZenohConfig(listen=("tcp/127.0.0.1:7447",), config_file=file))
    seen = {
        path: json.loads(config.get_json(path))
        for path in (
            "mode",
            "connect/endpoints",
            "listen/endpoints",
            "transport/link/tx/lease",
            "scouting/multicast/enabled",
        )
    }
    assert seen == {
        "mode": "peer",
        "connect/endpoints": ["tcp/10.0.0.1:7447"],
        "listen/endpoints": ["tcp/127.0.0.1:7447"],
        "transport/link/tx/lease": 5000,
        "scouting/multicast/enabled": False,
    }


def test_without_listen_the_session_opens_no_endpoint() -> None:
    assert json.loads(configure(ZenohConfig()).get_json("listen/endpoints")) == []


@pytest.mark.parametrize("text", ["{mode: ", "{nonsense: 1}", '{mode: "pear"}'])
def test_a_file_that_is_no_zenoh_configuration_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"config_file .*zenoh\.json5"):
        configure(ZenohConfig(config_file=file))


async def test_a_client_starts_while_its_first_router_is_down() -> None:
    absent, there = free_endpoint(), free_endpoint()
    config = configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(absent, there)))
    async with ZenohPeer("router", listen=[there]), asyncio.timeout(300):
        session = await open_session(config, retry=True)
        try:
            assert len(session.info.routers_zid()) == 1
        finally:
            await off_loop(session.close)
