"""The schemas of the contract are those of the types, and every document of a plant fits them."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import contract_reader, schemas
from gateway.config import load
from gateway.contract.access import certificates
from gateway.contract.documents.catalogue import FILE, PAST, SEND
from gateway.contract.documents.introspection import introspection
from gateway.contract.keys import CONTRACT, Keys
from gateway.contract.meta import meta
from gateway.tags.tag import WriteRule
from tests.conftest import Command
from tests.contract.faulty_plant import (
    QUERIES,
    REQUESTS,
    SUBSCRIBED,
    Plant,
    faulty_plant,
    replied,
    subscribed,
)
from tests.contract.reader import Reader
from tests.northbound.plant import PlainDevice
from tests.northbound.plant import tag as tag_of
from tests.zenoh_peer import TIMEOUT, ZenohPeer

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
    other = PlainDevice("oven", (tag_of("oven", "c"),), blocks=True, templates=("oven",))
    told = introspection(
        Keys("plant", "demo"),
        (device, other),
        {"mixer": frozenset({"stop", "run"}), "oven": frozenset({"run"})},
        signed=True,
        history=False,
    )
    plain = {"commands": [], "blocks": False, "templates": []}
    assert told["devices"] == {
        "mixer": plain | {"tags": 2, "writable": 1, "commands": ["run", "stop"]},
        "oven": plain | {"tags": 1, "writable": 0, "blocks": True, "templates": ["oven"]},
    }
    assert told["signed"]
    assert told["documents"]["value"] == {
        "key": "plant/{device}/{tag}",
        "verbs": ["subscribe", "get"],
    }
    assert told["documents"]["outcome"]["key"] == "plant/@gateway/demo/writes"
    assert not any(PAST in one["verbs"] for one in told["documents"].values())
    assert Reader(COMMITTED, "plant").violations("introspection", told) == []


def test_the_command_prints_the_schemas(command: Command) -> None:
    assert command("schema", "--contract").json == COMMITTED


# -- a running plant -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with faulty_plant(tmp_path_factory.mktemp("plant")) as found:
        yield found


async def test_every_document_of_a_plant_with_faults_fits(plant: Plant) -> None:
    """All kinds of documents but those that need TLS, signatures, or a flood of refusals."""
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        [served] = await client.get("plant/@gateway/*/@describe")
        assert served.json == COMMITTED
        reader = Reader(served.json, "plant")

        heard = [await client.subscribe(key) for key in SUBSCRIBED]
        await client.get_until("plant/mixer/recipe", lambda one: one["quality"] == "good")
        plant.plc.tell("set 1 D 20 1500")  # 150.0, beyond its clamp
        alarm = "plant/@gateway/demo/alarms/mixer/level"
        await client.get_until(alarm, lambda one: one["state"] == "active")
        answered = {kind.name for kind in schemas.KINDS if kind.verbs == (SEND,)} - {"file order"}
        async with asyncio.timeout(TIMEOUT):
            while not answered <= reader.seen:  # a busy machine may refuse one
                for (key, _), replies in zip(REQUESTS, await client.many(REQUESTS), strict=True):
                    replied(reader, key, SEND, replies)
        plant.plc.tell("deaf")
        line = "plant/@gateway/demo/lines/hall"
        await client.get_until(line, lambda one: not one["open"])
        plant.plc.tell("hear")
        await client.get_until(line, lambda one: one["open"])
        await client.get_until("plant/mixer/recipe", lambda one: one["quality"] == "good")

        for verb, selectors in QUERIES.items():
            for selector in selectors:
                replies = await client.get(selector, consolidation="NONE", accept_replies="ANY")
                assert replies, selector
                replied(reader, selector.partition("?")[0], verb, replies)
        told = await client.get_until("plant/@gateway/demo/@introspect", lambda _: True)
        assert "run" in told["devices"]["oven"]["commands"]
        assert (told["signed"], told["history"]) == (False, True)
        for subscription in heard:
            await subscription.until(lambda one: bool(one.samples))
            for sample in subscription.samples:
                subscribed(reader, sample)
    assert reader.wrong == []
    others = {"certificates", "outcome: suppressed", "remote", "file order"}
    assert reader.names - reader.seen == others


async def test_a_consumer_reads_the_plant_for_some_time(plant: Plant) -> None:
    """A slice of `make contract`."""
    reader = await contract_reader.read(plant, seconds=0.1, every=0.1)
    assert reader.wrong == []
    assert {"value", "meta", "status", "introspection"} <= reader.seen
