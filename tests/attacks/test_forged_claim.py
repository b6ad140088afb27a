"""A program that claims devices in the name of a gateway takes none off, and ends no gateway."""

import asyncio
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

import pytest
import yaml
import zenoh

from tests.attacks.security_pages import block
from tests.e2e.processes import gateway, started, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

EARLIEST = b'{"ticket": 1, "group": null, "devices": ["mixer"]}'
CLAIMS = ("plant/@gateway/evil/claim/f00d", "plant/@gateway/demo/claim/beef")


def client_of(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def forged_claims(
    endpoint: str, keys: Iterable[str] = CLAIMS, document: bytes = EARLIEST
) -> Iterator[None]:
    """Claims the mixer before all others, and the name of the gateway."""
    with client_of(endpoint) as session:
        kept: list[object] = []
        for key in keys:

            def answer(query: zenoh.Query, key: str = key) -> None:
                with query:
                    query.reply(key, document)

            kept.append(session.declare_queryable(key, answer))
            kept.append(session.liveliness().declare_token(key))
        yield


async def test_forged_claims_are_refused_and_those_of_the_plant_count(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    secret(tmp_path / "plant.txt", "a secret of twenty or more\n")
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}

    def file(name: str, **zenoh: list[str]) -> Path:
        own = yaml.safe_load(block("Several gateways", "yaml"))["gateway"] | {"name": name}
        return write_config(
            tmp_path / f"{name}.yaml", endpoint, lines, gateway=own, zenoh={**zenoh}
        )

    with await asyncio.to_thread(started, file("demo", listen=[endpoint])) as program:
        await asyncio.to_thread(program.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            with forged_claims(endpoint):
                for key in CLAIMS:
                    await asyncio.to_thread(program.says, "claim refused", key)
                status = await client.get_until(
                    "plant/@gateway/demo/status", lambda found: len(found["refused_claims"]) == 2
                )
                assert sorted(status["refused_claims"]) == sorted(CLAIMS)
                assert status["refused_devices"] == {}
                [reply] = await client.get("plant/mixer/speed?max_age=0s")
                assert reply.json["quality"] == "good"
            await client.get_until(
                "plant/@gateway/demo/status", lambda found: found["refused_claims"] == []
            )
        assert not program.has_said("device refused")
        # Another gateway with the secret leaves the device to the first.
        with gateway("run", file("second", listen=[], connect=[endpoint])) as second:
            assert await asyncio.to_thread(second.ended) == 1
            assert second.has_said("gateway demo serves every device of this file already")
        assert program.running


@pytest.mark.parametrize(
    "document",
    [
        b'{"ticket": 18446744073709551615, "group": null, "devices": []}',
        b'{"ticket": 4611686018427387904, "group": null, "devices": []}',
        b"[" * 100_000,
    ],
    ids=["64 bits", "the last ticket", "nested"],
)
async def test_a_claim_of_any_client_keeps_no_gateway_from_starting(
    document: bytes, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(
        tmp_path / "plant.yaml", endpoint, lines, zenoh={"listen": [], "connect": [endpoint]}
    )
    async with ZenohPeer("router", listen=[endpoint]):
        with (
            forged_claims(endpoint, CLAIMS[:1], document),
            await asyncio.to_thread(started, path) as program,
        ):
            await asyncio.to_thread(program.says, "device online")
            async with ZenohPeer("client", connect=[endpoint]) as client:
                [claim] = await client.get("plant/@gateway/demo/claim/*")
                assert claim.json["ticket"] <= 2**62


async def test_tokens_without_claims_are_asked_for_together_and_ever_more_rarely(
    tmp_path: Path,
) -> None:
    endpoint = free_endpoint()
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(tmp_path / "plant.yaml", endpoint, lines)
    with await asyncio.to_thread(started, path) as program, client_of(endpoint) as session:
        asked: Queue[str] = Queue()

        def silent(query: zenoh.Query) -> None:
            with query:
                asked.put(str(query.key_expr))

        kept: list[object] = [session.declare_queryable("plant/@gateway/*/claim/*", silent)]
        live = session.liveliness()
        kept += [
            live.declare_token(f"plant/@gateway/evil/claim/{number}") for number in range(1500)
        ]
        async with ZenohPeer("client", connect=[endpoint]) as client:
            await client.until_alive("plant/@gateway/demo", ["plant/@gateway/demo"])
            first = await asyncio.to_thread(asked.get, True, 30)
            assert first == "plant/@gateway/*/claim/*"
            await asyncio.to_thread(program.says, "device online")
            with forged_claims(endpoint, CLAIMS[:1]):  # a claim among them counts as before
                await asyncio.to_thread(program.ended)
        assert asked.qsize() < 20
        assert program.has_said("gateway evil serves")
