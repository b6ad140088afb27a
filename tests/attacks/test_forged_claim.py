"""A program that claims devices in the name of a gateway takes none off, and ends no gateway."""

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml
import zenoh

from tests.attacks.security_pages import block
from tests.e2e.processes import gateway, started, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

CLAIMS = ("plant/@gateway/evil/claim/f00d", "plant/@gateway/demo/claim/beef")


@contextmanager
def forged_claims(endpoint: str) -> Iterator[None]:
    """Claims the mixer before all others, and the name of the gateway."""
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(path, json.dumps(value))
    document = json.dumps({"ticket": 1, "group": None, "devices": ["mixer"]})
    with zenoh.open(config) as session:
        kept: list[object] = []
        for key in CLAIMS:

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
