"""Claims count if they are signed with the secret of the plant."""

from typing import Any

import orjson
import pytest
from structlog.testing import capture_logs

from gateway.contract.keys import Keys
from gateway.northbound.group.claim_documents import ClaimDocuments
from gateway.northbound.group.claims import LAST_TICKET, Claim
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.tags.tag import NotReal

SECRET = PlantSecret("a secret of twenty or more")
CLAIM = Claim(7, "5e55", "a", None, frozenset({"mixer", "oven"}))
KEY = "plant/@gateway/a/claim/5e55"
SIGNED = ClaimDocuments(Keys("plant", "a"), SECRET).document(CLAIM, {})
FORGED = {
    "no signature": {"ticket": 7, "group": None, "devices": ["mixer", "oven"]},
    "a signature of nothing": SIGNED | {"signature": ""},
    "no text": SIGNED | {"signature": 7},
    "not ASCII": SIGNED | {"signature": "\u00fc"},
    "another ticket": SIGNED | {"ticket": 1},
    "another group": SIGNED | {"group": "hall"},
    "other devices": SIGNED | {"devices": ["mixer", "oven", "press"]},
}


def other(secret: PlantSecret | None = SECRET) -> ClaimDocuments:
    return ClaimDocuments(Keys("plant", "b"), secret)


def test_a_gateway_of_the_plant_knows_the_claim_of_another() -> None:
    documents = other()
    assert documents.parse(KEY, orjson.dumps(SIGNED), 0.0) == CLAIM
    assert documents.refused == []


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED)
def test_a_forged_claim_is_refused_and_named_once(forged: dict[str, Any]) -> None:
    documents = other()
    with capture_logs() as logs:
        for _ in range(3):  # it is read again, until its token ends
            assert documents.parse(KEY, orjson.dumps(forged), 0.0) is None
    assert [(entry["event"], entry["claim"]) for entry in logs] == [("claim refused", KEY)]
    assert documents.refused == [KEY]
    documents.forget(KEY)
    assert documents.refused == []


@pytest.mark.parametrize("name", ["plant/@gateway/b/claim/5e55", "plant/@gateway/a/claim/0"])
def test_a_signature_is_good_for_one_gateway_and_its_session(name: str) -> None:
    assert other().parse(name, orjson.dumps(SIGNED), 0.0) is None


def test_without_a_secret_every_claim_counts() -> None:
    without = other(None)
    for document in (SIGNED, FORGED["no signature"], without.document(CLAIM, {})):
        assert without.parse(KEY, orjson.dumps(document), 0.0) == CLAIM


def test_a_claim_names_the_devices_that_are_not_real() -> None:
    origins: dict[str, NotReal] = {"mixer": "simulated", "press": "replayed"}
    document = ClaimDocuments(Keys("plant", "a"), SECRET).document(CLAIM, origins)
    assert document["origins"] == {"mixer": "simulated"}  # the press is none of its devices
    assert "origins" not in SIGNED
    assert other().parse(KEY, orjson.dumps(document), 0.0) == CLAIM


WRONG = {
    "no JSON": b"",
    "a list": b"[]",
    "no devices": b'{"ticket": 7}',
    "a text as ticket": b'{"ticket": "7", "devices": []}',
    "a truth value as ticket": b'{"ticket": true, "devices": []}',
    "a ticket below 0": b'{"ticket": -1, "devices": []}',
    "the largest 64 bits": b'{"ticket": 18446744073709551615, "devices": []}',
    "more than 64 bits": b'{"ticket": 18446744073709551616, "devices": []}',
    "one after the last": b'{"ticket": %d, "devices": []}' % (LAST_TICKET + 1),
    "a group of lists": b'{"ticket": 7, "group": [], "devices": []}',
    "a device of another type": b'{"ticket": 7, "devices": ["mixer", 7]}',
    "a device without an end": b'{"ticket": 7, "devices": ["%b"]}' % (b"x" * 1000),
    "too many devices": orjson.dumps({"ticket": 7, "devices": ["a"] * 10_001}),
    "too long": b'{"ticket": 7, "devices": [], "more": "%b"}' % (b"x" * 300_000),
    "nested without an end": b"[" * 100_000,
}


@pytest.mark.parametrize("data", WRONG.values(), ids=WRONG)
def test_a_document_that_is_no_claim_is_refused_and_named(data: bytes) -> None:
    for secret in (None, SECRET):
        documents = other(secret)
        assert documents.parse(KEY, data, 0.0) is None
        assert documents.refused == [KEY]


def test_a_flood_of_forged_claims_is_told_a_few_times() -> None:
    documents = other()
    with capture_logs() as logs:
        for number in range(1000):
            key = f"plant/@gateway/a/claim/{number}"
            assert documents.parse(key, orjson.dumps(SIGNED), 0.0) is None
    assert len(logs) == len(documents.refused) == 10
