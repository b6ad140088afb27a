"""The schemas of the contract are those of the types, and every document of a plant fits them."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from benchmarks import schemas
from gateway.config import load
from gateway.contract.access import certificates
from gateway.contract.documents.catalogue import FILE, GET, KINDS, PAST, SEND, SUBSCRIBE
from gateway.contract.documents.introspection import introspection
from gateway.contract.keys import CONTRACT, Keys
from gateway.contract.meta import meta
from gateway.tags.tag import WriteRule
from tests.contract.reader import Reader
from tests.e2e.processes import (
    Program,
    free_port,
    plc_gateway,
    started,
    station,
    vigor_line,
    write_config,
)
from tests.northbound.plant import PlainDevice
from tests.northbound.plant import tag as tag_of
from tests.zenoh_peer import TIMEOUT, Received, Reply, ZenohPeer, free_endpoint

ROOT = Path(__file__).parents[2]
CHANGED = (
    "a document has another shape: read docs/contract.md. Something new needs a line there, "
    "everything else another CONTRACT; then run `make schema`"
)
COMMITTED: dict[str, Any] = json.loads(FILE.read_text("utf-8"))


def test_the_committed_schemas_are_those_of_the_types() -> None:
    assert schemas.text(schemas.schema()) == FILE.read_text("utf-8"), CHANGED
    assert schemas.text(schemas.asyncapi(COMMITTED)) == schemas.ASYNCAPI.read_text("utf-8"), CHANGED


def test_the_page_has_the_number_of_the_contract() -> None:
    page = (ROOT / "docs" / "contract.md").read_text("utf-8")
    assert page.startswith(f"# Contract {CONTRACT}\n")
    assert COMMITTED["contract"] == CONTRACT


def test_every_reference_leads_to_a_type() -> None:
    for path, shared in ((FILE, "$defs"), (schemas.ASYNCAPI, "components/schemas")):
        text = path.read_text("utf-8")
        document: Any = json.loads(text)
        for part in shared.split("/"):
            document = document[part]
        found = {one.split('"')[0] for one in text.split(f'"#/{shared}/')[1:]}
        assert found
        assert found <= set(document)


def test_a_missing_or_another_field_is_a_violation() -> None:
    reader = Reader(COMMITTED, "plant")
    good = {"value": 1.5, "quality": "good", "time": "2026-11-20T12:00:00.123456Z"}
    assert reader.violations("value", good) == []
    for wrong in (
        {**good, "value": None},
        {**good, "quality": "bad"},
        {**good, "quality": "fine"},
        {**good, "time": "noon"},
        {**good, "origin": "guessed"},
        {**good, "more": 1},
        {"value": 1.5, "quality": "good"},
    ):
        assert reader.violations("value", wrong)


def test_the_descriptions_of_all_examples_fit() -> None:
    reader = Reader(COMMITTED, "plant")
    files = [ROOT / "config.example.yaml", *sorted((ROOT / "examples").glob("*.yaml"))]
    for tag in (tag for file in files for device in load(file).devices for tag in device.tags):
        assert reader.violations("meta", json.loads(meta(tag))) == [], tag.key


def test_a_certificate_fits() -> None:
    reader = Reader(COMMITTED, "plant")
    for found in (2e9, "no such file"):
        document = certificates.document(Path("ca.pem"), found, 1.7e9)
        assert reader.violations("certificates", document) == []


def test_a_gateway_says_what_it_permits() -> None:
    device = PlainDevice(
        "mixer", (tag_of("mixer", "a", write=WriteRule()), tag_of("mixer", "b")), control=True
    )
    other = PlainDevice("oven", (tag_of("oven", "c"),), blocks=True)
    told = introspection(
        Keys("plant", "demo"),
        (device, other),
        {"mixer": frozenset({"stop", "run"}), "oven": frozenset({"run"})},
        signed=True,
        history=False,
    )
    assert told["devices"] == {
        "mixer": {"tags": 2, "writable": 1, "commands": ["run", "stop"], "blocks": False},
        "oven": {"tags": 1, "writable": 0, "commands": [], "blocks": True},
    }
    assert told["signed"]
    assert told["documents"]["value"] == {
        "key": "plant/{device}/{tag}",
        "verbs": ["subscribe", "get"],
    }
    assert told["documents"]["outcome"]["key"] == "plant/@gateway/demo/writes"
    assert not any(PAST in one["verbs"] for one in told["documents"].values())
    assert Reader(COMMITTED, "plant").violations("introspection", told) == []


def test_the_command_prints_the_schemas() -> None:
    assert json.loads(plc_gateway("schema", "--contract").out) == COMMITTED


# -- a running plant -------------------------------------------------------------------------------

TAGS = {
    "speed": {"address": "D10", "history": True},  # counts
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}, "history": True},
    "trim": {"address": "D501", "write": True},
    "hole": {"address": "D700"},
    "level": {
        "address": "D20",
        "scale": 0.1,
        "decimals": 1,
        "clamp": [0, 100],
        "alarm": {"high": 80, "hysteresis": 1, "text": "full"},
    },
    "mode": {"address": "D21", "enum": {0: "off", 1: "auto"}, "write": True},
    "steps": {"address": "D510", "type": "uint16[4]"},
    "name": {"address": "D600", "type": "string[8]"},
    "plain": {"address": "D30", "payload": "raw"},
    "double": {"computed": "speed * 2"},
    "power": {"address": "D40", "type": "float32"},
}
_LINK = {"protocol": "computer-link", "control": True, "frame_format": 4}
LINES = {
    "sim": {
        "port": "simulator",
        "baudrate": 19200,
        "format": "7E1",
        "devices": {
            "oven": {
                **_LINK,
                "station": 5,
                "blocks": True,
                "tags": {"heat": {"address": "D0100", "write": True}},
            }
        },
    },
    "gone": {
        "port": f"tcp://127.0.0.1:{free_port()}",
        "devices": {
            "far": {
                "protocol": "modbus-tcp",
                "station": 1,
                "tags": {"flow": {"address": "holding:1"}},
            }
        },
    },
}
SERVED = {
    "serve": True,
    "devices": {
        "panel": {
            "protocol": "modbus-tcp",
            "tags": {"shown": {"address": "holding:0", "source": "mixer/speed"}},
        }
    },
}


class Plant(NamedTuple):
    endpoint: str
    plc: Program


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """A plant with a PLC that loses replies and lacks an address, a dead line, a served one."""
    folder = tmp_path_factory.mktemp("plant")
    endpoint, own = free_endpoint(), str(folder / "tty")
    hall = vigor_line(own, TAGS, retries=0)
    hall["devices"]["mute"] = {
        **hall["devices"]["mixer"],
        "station": 2,
        "tags": {"a": {"address": "D1"}},
    }
    door = {"line": "hall", "listen": f"127.0.0.1:{free_port()}", "protocol": "vigor"}
    config = write_config(
        folder / "config.yaml",
        endpoint,
        {**LINES, "hall": hall, "panel": {"port": f"tcp://127.0.0.1:{free_port()}", **SERVED}},
        history={"path": "history.db"},
        alarms={"path": "alarms.json", "devices": True, "lines": True},
        gateway={"name": "demo", "standby": "hall", "audit": "audit.jsonl"},
        share={"doors": {"laptop": door}},
        transfers=[{"from": "mixer/speed", "to": "mixer/trim", "every": "1s", "stale": "9s"}],
    )
    with station("pty", own, stations=(1, 2)) as plc:
        plc.tell("hole 1 D 700")
        plc.tell("count 1 D 10")
        plc.tell("mute 2")
        with started(config):
            yield Plant(endpoint, plc)


async def test_every_document_of_a_plant_with_faults_fits(plant: Plant) -> None:
    """All kinds of documents but the two that need TLS, or a flood of refusals."""
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        [served] = await client.get("plant/@gateway/*/@describe")
        assert served.json == COMMITTED
        reader = Reader(served.json, "plant")

        heard = [await client.subscribe(key) for key in (
            "plant/**",
            "plant/*/@block",
            "plant/@gateway/**",
            "plant/@gateway/demo/lines/hall/@trace",
        )]  # fmt: skip
        requests = [
            ("plant/mixer/recipe/@set", b"5"),
            ("plant/mixer/recipe/@set", b"99"),
            ("plant/mixer/speed/@set", b"1"),
            ("plant/mixer/@set", b'{"recipe": 6, "trim": 1}'),
            ("plant/mixer/@set", b'{"recipe": 6, "speed": 1}'),
            ("plant/mute/a/@set", b"1"),
            ("plant/oven/heat/@set", b"7"),
            ("plant/oven/@run", b""),
            ("plant/oven/@loopback", b"AB"),
            ("plant/@gateway/demo/lines/sim/global", b"on"),
            ("plant/mixer/@peek", b"D10..D12"),
            ("plant/mixer/@peek", b"nothing"),
            ("plant/@gateway/demo/alarms/mixer/level", b'{"by": "Ana"}'),
            ("plant/@gateway/demo/alarms/mixer/level", b"{}"),
        ]
        await client.get_until("plant/mixer/recipe", lambda one: one["quality"] == "good")
        plant.plc.tell("set 1 D 20 1500")  # 150.0, beyond its clamp
        alarm = "plant/@gateway/demo/alarms/mixer/level"
        await client.get_until(alarm, lambda one: one["state"] == "active")
        answered = {kind.name for kind in KINDS if kind.verbs == (SEND,)}
        async with asyncio.timeout(TIMEOUT):
            while not answered <= reader.seen:  # a busy machine may refuse one
                for (key, _), replies in zip(requests, await client.many(requests), strict=True):
                    _read(reader, key, SEND, replies)
        plant.plc.tell("deaf")
        line = "plant/@gateway/demo/lines/hall"
        await client.get_until(line, lambda one: not one["open"])
        plant.plc.tell("hear")
        await client.get_until(line, lambda one: one["open"])
        await client.get_until("plant/mixer/recipe", lambda one: one["quality"] == "good")

        queries = {
            GET: [
                "plant/**",
                "plant/**/@meta",
                "plant/*/@block",
                "plant/@gateway/**",
                "plant/@gateway/*/@describe",
                "plant/@gateway/*/@introspect",
                "plant/mixer/**?page=3",
                "plant/mixer/speed?max_age=0s",
                "plant/mixer/speed?max_age=never",
            ],
            PAST: [
                "plant/mixer/**?_time=[now(-1h)..]",
                "plant/mixer/speed?_time=[now(-1h)..];bucket=1h",
                "plant/mixer/recipe?_time=[never]",
                "plant/@gateway/demo/writes?_time=[now(-1h)..]",
                "plant/@gateway/demo/alarms/**?_time=[now(-1h)..]",
                "plant/@gateway/demo/audit/*?_time=[now(-1h)..]",
            ],
        }
        for verb, selectors in queries.items():
            for selector in selectors:
                replies = await client.get(selector, consolidation="NONE", accept_replies="ANY")
                assert replies, selector
                _read(reader, selector.partition("?")[0], verb, replies)
        told = await client.get_until("plant/@gateway/demo/@introspect", lambda _: True)
        assert "run" in told["devices"]["oven"]["commands"]
        assert (told["signed"], told["history"]) == (False, True)
        for subscription in heard:
            await subscription.until(lambda one: bool(one.samples))
            for sample in subscription.samples:
                _subscribed(reader, sample)
    assert reader.wrong == []
    assert reader.names - reader.seen == {"certificates", "outcome: suppressed"}


def _read(reader: Reader, key: str, verb: str, replies: list[Reply]) -> None:
    for reply in replies:
        if reply.encoding == "application/json":
            assert reply.ok or "error" in reply.json
            reader.read(reply.key or key, verb, reply.json)


def _subscribed(reader: Reader, sample: Received) -> None:
    if sample.attachment:
        reader.read(sample.key, SUBSCRIBE, json.loads(sample.attachment))
    if sample.encoding == "application/json" and sample.payload:
        reader.read(sample.key, SUBSCRIBE, sample.json)
