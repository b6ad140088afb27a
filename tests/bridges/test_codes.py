"""The status codes of `bridge opcua` are complete, and those of docs/opcua.md."""

import json
import re

import pytest

from gateway.bridges.documents import described_by, parsed
from gateway.contract.documents.catalogue import FILE
from gateway.contract.problems import Problem
from gateway.tags import Reason
from tests.bridges.played import META
from tests.e2e.processes import ROOT

OPCUA = ROOT / "gateway" / "bridges" / "opcua"
PAGE = (ROOT / "docs" / "opcua.md").read_text("utf-8")
NOT_OF_WRITES = {Problem.BAD_QUERY, Problem.DAMAGED, Problem.NO_HISTORY}
NOT_OF_WRITES |= {Problem.NOTHING_TO_ACKNOWLEDGE}
NOT_OF_WRITES |= {Problem.NOT_SENT, Problem.INCOMPLETE}  # of several tags at once


def codes(file: str) -> dict[str, str]:
    pairs = re.findall(r'^    "([\w-]+)": Code\.(\w+),$', (OPCUA / file).read_text(), re.MULTILINE)
    return dict(pairs)


def on_the_page(heading: str) -> dict[str, str]:
    table = PAGE.partition(heading)[2].partition("\n\n")[0]
    return dict(re.findall(r"^\| `([\w-]+)`[^|]*\| (\w+)", table, re.MULTILINE))


def test_every_reason_of_a_bad_value_has_the_code_of_the_page() -> None:
    table = json.loads(FILE.read_text("utf-8"))["reasons"]
    known = {reason: one["opcua"] for reason, one in table.items()}
    known["no-gateway"] = "BadNoCommunication"
    assert known == on_the_page("| status code of the value |")
    assert set(known) == {*Reason, "no-gateway"}
    signals = dict(re.findall(r"^\| `([\w-]+)`[^|]*\| \w+ \| (\w) \|$", PAGE, re.MULTILINE))
    assert signals == {reason: one["ne107"] for reason, one in table.items()}


def test_every_outcome_of_a_write_has_the_code_of_the_page() -> None:
    known = codes("bridge.py")
    assert {**known, "unclear": "BadTimeout"} == on_the_page("| status code of the write |")
    assert set(known) == {*Problem, "no-gateway"} - NOT_OF_WRITES - {Problem.UNCLEAR}
    assert "BadTimeout" not in known.values()


@pytest.mark.parametrize(
    "about",
    [
        {"time": "0001-01-01T00:00:00+14:00"},
        {"time": "1970-01-01T00:00:00Z"},
        {"time": "2026-01-01T00:00:00"},
        {"reason": [1]},
        {"origin": {"a": 1}},
        {"limited": 5},
        {"text": []},
        {"quality": "great"},
        {"quality": "uncertain"},
        {"quality": "bad"},
        {"value": None},
        {"value": [1, "2"]},
        {"value": {"a": 1}},
    ],
    ids=str,
)
def test_a_document_of_another_program_is_garbled(about: dict[str, object]) -> None:
    known = {"value": 7, "quality": "good", "time": "2026-01-01T00:00:00Z"}
    assert parsed(META, True, json.dumps(known).encode(), b"") == known
    found = parsed(META, True, json.dumps(known | about).encode(), b"")
    assert (found["value"], found["reason"]) == (None, "garbled")


@pytest.mark.parametrize("payload", [b"\xff", b"[]", b"7", b'{"value": NaN}', b"9" * 5000, b""])
def test_bytes_of_another_program_are_garbled(payload: bytes) -> None:
    assert parsed(META, True, payload, b"")["reason"] == "garbled"
    assert described_by("a/b", payload) is None


@pytest.mark.parametrize("key", ["a/b+", "a/b\0", "a/b\nplc,device=oven"])
def test_a_key_that_no_broker_takes_is_no_tag(key: str) -> None:
    meta = b'{"type": "int16"}'
    assert described_by("a/b c", meta) is not None
    assert described_by(key, meta) is None
