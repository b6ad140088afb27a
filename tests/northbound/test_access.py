"""Zenoh's access control with the rules of docs/security.md: users and mutual TLS."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config import TlsConfig, ZenohConfig
from gateway.northbound import Northbound
from tests.northbound.access import (
    GATEWAY_RULES,
    PASSWORDS,
    ROUTER_RULES,
    as_user,
    certificates,
    rules,
    secret,
    users,
)
from tests.northbound.plant import PlainPlant, mixer, running, until
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
COMMANDS = {"oven": frozenset({"run", "stop"})}


@asynccontextmanager
async def behind_a_router(plant: PlainPlant, folder: Path) -> AsyncIterator[tuple[Any, str]]:
    endpoint = free_endpoint()
    config = {
        "access_control": rules(ROUTER_RULES),
        "transport/auth/usrpwd/dictionary_file": str(users(folder)),
    }
    password = secret(folder / "password.txt", PASSWORDS["gateway"] + "\n")
    settings = ZenohConfig(connect=(endpoint,), user="gateway", password_file=password)
    async with ZenohPeer("router", listen=[endpoint], config=config):
        plant.known_commands = COMMANDS
        northbound = Northbound(settings, "demo", plant)
        async with running(northbound):
            await until(lambda: northbound.counters()["links"] == 1)
            yield northbound, endpoint


@asynccontextmanager
async def by_itself(plant: PlainPlant, folder: Path) -> AsyncIterator[tuple[Any, str]]:
    endpoint = free_endpoint()
    file = folder / "access.json5"
    file.write_text(GATEWAY_RULES)
    settings = ZenohConfig(listen=(endpoint,), config_file=file, users_file=users(folder))
    plant.known_commands = COMMANDS
    northbound = Northbound(settings, "demo", plant)
    async with running(northbound):
        yield northbound, endpoint


async def test_behind_a_router_a_second_gateway_leaves_the_devices_to_the_first(
    tmp_path: Path,
) -> None:
    async with behind_a_router(mixer(), tmp_path) as (_, endpoint):
        settings = ZenohConfig(
            connect=(endpoint,), user="gateway", password_file=tmp_path / "password.txt"
        )
        second = Northbound(settings, "second", mixer())
        serves = asyncio.create_task(second.run())
        async with asyncio.timeout(5):
            await second.replaced.wait()
        assert second.withheld == {"mixer": "demo", "oven": "demo"}
        assert not second.active.is_set()
        serves.cancel()
        await asyncio.wait([serves])


@pytest.mark.parametrize("guarded", [behind_a_router, by_itself])
async def test_a_viewer_reads_an_operator_writes_and_strangers_do_neither(
    guarded: Callable[..., Any], tmp_path: Path
) -> None:
    plant = mixer(blocks=True)
    async with (
        guarded(plant, tmp_path) as (northbound, endpoint),
        as_user("viewer", endpoint) as viewer,
        as_user("operator", endpoint) as operator,
    ):
        live = await viewer.liveliness("plant/@gateway/*")
        await live.next(lambda token: token.key == "plant/@gateway/demo")
        for reader in (viewer, operator):
            received = await reader.subscribe("plant/**")
            for _ in range(100):  # Zenoh does not report when a subscription is known everywhere
                northbound.publish([plant.now("mixer/speed", 12)])
                if received.samples:
                    break
                await asyncio.sleep(0.05)
            assert received.samples
            for selector, count in (
                ("plant/**", 4),
                ("plant/**/@meta", 4),
                ("plant/*/@block", 1),
                ("plant/@gateway/demo/status", 1),
                ("plant/mixer/speed?max_age=1h", 1),
            ):
                assert len(await reader.get(selector, consolidation="NONE")) == count, selector
            late = await reader.subscribe("plant/**", advanced=True)
            await late.until(lambda of: len(of.latest()) == 4)
        audit = await viewer.subscribe("plant/@gateway/demo/writes")

        # The viewer tries every way to write.
        before = northbound.counters()["queries"]
        for key in (RECIPE, "plant/mixer/**/@set", "plant/**/@set", "plant/**", "**", "**/@set"):
            replies = await viewer.get(key, b"7", target="ALL")
            assert not any(reply.key == RECIPE[:-5] + "/@set" for reply in replies)
            await viewer.put(key, b"7")
            await viewer.delete(key)
        assert northbound.counters()["queries"] == before + 1  # `plant/**`, a question for values
        assert plant.written == []

        # The operator writes with a query; a put is not allowed.
        [reply] = await operator.get(RECIPE, b"7")
        assert reply.ok
        await audit.next(lambda line: line.json["outcome"] == "written")
        for key in ("plant/mixer/**/@set", "plant/**/@set"):
            for reply in await operator.get(key, b"8"):
                assert reply.json["error"] == "unknown-tag"
        await operator.put(RECIPE, b"9")
        [reply] = await operator.get(RECIPE, b"10")  # after the put, on the same way
        assert reply.ok
        assert plant.written == [("mixer/recipe", 7), ("mixer/recipe", 10)]

        # Clients without a user, or with a wrong password, cannot connect.
        for stranger in (
            ZenohPeer("client", connect=[endpoint], config={"connect/timeout_ms": 500}),
            as_user("operator", endpoint, "wrong"),
        ):
            assert await cannot_connect(stranger)


@pytest.mark.parametrize("guarded", [behind_a_router, by_itself])
async def test_neither_a_viewer_nor_an_operator_sends_commands(
    guarded: Callable[..., Any], tmp_path: Path
) -> None:
    plant = mixer()
    async with guarded(plant, tmp_path) as (_, endpoint):
        for name in ("viewer", "operator"):
            async with as_user(name, endpoint) as person:
                assert len(await person.get("plant/@gateway/demo/status")) == 1
                for key in ("plant/oven/@stop", "plant/@gateway/demo/lines/hall/global"):
                    assert await person.get(key, b"on", target="ALL") == []
    assert plant.commanded == []


async def cannot_connect(peer: ZenohPeer) -> bool:
    """True if the session is refused."""
    peer.config["connect/timeout_ms"] = 500
    try:
        async with peer:
            return False
    except ConnectionError:
        return True


async def test_mutual_tls_admits_clients_with_a_signed_certificate(tmp_path: Path) -> None:
    signed = certificates(tmp_path)
    certificate, key = signed("gateway")
    tls = TlsConfig(ca=tmp_path / "ca.pem", certificate=certificate, key=key, mutual=True)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    plant = mixer()
    own_certificate, own_key = signed("operator")
    link = "transport/link/tls"
    anonymous = {f"{link}/root_ca_certificate": str(tmp_path / "ca.pem")}
    known = anonymous | {
        f"{link}/enable_mtls": True,
        f"{link}/connect_certificate": str(own_certificate),
        f"{link}/connect_private_key": str(own_key),
    }
    async with running(Northbound(ZenohConfig(listen=(endpoint,), tls=tls), "demo", plant)):
        async with ZenohPeer("client", connect=[endpoint], config=known) as client:
            [reply] = await client.get(RECIPE, b"7")
            assert reply.ok
        # Without a certificate the link is closed as soon as it is open.
        stranger = ZenohPeer("client", connect=[endpoint], config=anonymous)
        assert await cannot_connect(stranger)
    assert plant.written == [("mixer/recipe", 7)]
