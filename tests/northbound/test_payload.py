"""The JSON on Zenoh, byte for byte."""

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.contract import payload
from gateway.contract.meta import meta
from gateway.contract.parsing import parse_write
from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.errors import (
    BadValue,
    Busy,
    Garbled,
    GatewayError,
    LineDown,
    NoReply,
    Refused,
    Unclear,
)
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Deadband, Reason, Tag, WriteResult, WriteRule, bad, good
from gateway.tags.shaping import Names
from gateway.values import Layout, Value, parse_type
from tests.tag_settings import grouped

NOON = 1_795_176_000_123_456_789  # 2026-11-20T12:00:00.123456789Z


def tag(name: str = "speed", kind: str = "int16", **settings: Any) -> Tag:
    return Tag(
        device="mixer",
        name=name,
        text="D100",
        address=Address("D", 100),
        span=Span("D", 100, 1),
        unit_kind=Unit.WORD,
        layout=Layout(parse_type(kind)),
        **grouped(**settings),
    )


def test_a_good_value_as_the_contract_prints_it() -> None:
    assert payload.value(good(tag(), 12.5, NOON)) == (
        b'{"value":12.5,"quality":"good","time":"2026-11-20T12:00:00.123456Z"}'
    )


def test_a_value_has_its_name_beside_it_if_there_is_one() -> None:
    mode = tag(names=Names({0: "off", 1: "auto"}))
    assert json.loads(payload.value(good(mode, 1, NOON))) == {
        "value": 1,
        "text": "auto",
        "quality": "good",
        "time": "2026-11-20T12:00:00.123456Z",
    }
    assert payload.value(good(mode, 7, NOON)) == payload.value(good(tag(), 7, NOON))
    assert "text" not in json.loads(payload.value(bad(mode, Reason.NO_REPLY, NOON)))


@pytest.mark.parametrize("reason", list(Reason))
def test_a_bad_value_is_null_with_its_reason(reason: Reason) -> None:
    document = json.loads(payload.value(bad(tag(), reason, NOON, "the station is silent")))
    assert document == {
        "value": None,
        "quality": "bad",
        "reason": reason.value,
        "time": "2026-11-20T12:00:00.123456Z",
        "detail": "the station is silent",
    }


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_that_json_lacks_is_never_a_good_null(value: float) -> None:
    document = json.loads(payload.value(good(tag(), value, NOON)))
    assert (document["quality"], document["reason"]) == ("bad", "not-a-number")


@given(
    st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(max_codepoint=255))
)
@settings(max_examples=150)
def test_every_value_arrives_unchanged(value: Value) -> None:
    document = json.loads(payload.value(good(tag(), value, NOON)))
    assert document["value"] == value
    assert type(document["value"]) is type(value)
    assert document["quality"] == "good"


def test_a_block_holds_every_tag_by_name() -> None:
    samples = [good(tag("speed"), 12, NOON), bad(tag("alarms/door"), Reason.NO_REPLY, NOON)]
    document = json.loads(payload.block(samples))
    assert document["speed"]["value"] == 12
    assert document["alarms/door"]["reason"] == "no-reply"


def test_meta_holds_type_address_interval_and_limits() -> None:
    rule = WriteRule(min=1, max=40, verify=True)
    of = tag(kind="float32", unit="rpm", write=rule, deadband=Deadband(0.5), every=0.5)
    document = json.loads(meta(of))
    assert document["type"] == "float32"
    assert document["address"] == "D100"
    assert document["unit"] == "rpm"
    assert document["every"] == 0.5
    assert document["write"] == {"min": 1, "max": 40, "verify": True}
    assert document["deadband"] == {"amount": 0.5, "percent": False}
    assert json.loads(meta(tag()))["write"] is None


@pytest.mark.parametrize(
    ("sent", "value"),
    [
        (b"true", True),
        (b"12.5", 12.5),
        (b"12", 12),
        (b'"AB"', "AB"),
        (b'{"value": 12.5}', 12.5),
        (b' {"value": false} ', False),
        (b"18446744073709551615", 2**64 - 1),
        (b"-9223372036854775809", -(2**63) - 1),  # exactly, so that it can be refused
    ],
)
def test_a_write_is_a_scalar_or_an_object_with_the_value(sent: bytes, value: Value) -> None:
    found = parse_write(sent)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("sent", [b'[true, 1, 1.0, "A"]', b'{"value": [true, 1, 1.0, "A"]}'])
def test_a_write_of_an_array_is_a_list(sent: bytes) -> None:
    found = parse_write(sent)
    assert found == (True, 1, 1.0, "A")
    assert list(map(type, found)) == [bool, int, float, str]
    assert json.loads(payload.outcome(WriteResult(found, NOON, 0.03)))["value"] == [
        True,
        1,
        1.0,
        "A",
    ]


def test_the_audit_of_a_list_has_a_printable_size() -> None:
    assert payload.loggable((2**70, 1.5)) == ["1180591620717411303424", 1.5]
    assert payload.loggable((1,) * 128) == [1] * 128
    assert payload.loggable((True,) * 129) == f"[{'true,' * 59}true…"


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b" \n",
        b"null",
        b"[[1]]",
        b"[null]",
        b'[{"value": 1}]',
        b"[1, NaN]",
        b"[" + b"0," * 2000 + b"0]",
        b"{}",
        b'{"value": null}',
        b'{"value": {"value": 1}}',
        b'{"value": 1, "value": 2}',
        b'{"value": 1, "quality": "good"}',
        b'{"valu": 1}',
        b"NaN",
        b"-Infinity",
        b"1e400",
        b"1e-400",
        b"[-0.01e-999]",
        b"9" * 5000,
        b"12.5 13",
        b"0x10",
        b"tru",
        b'"AB',
        b'"\\ud800"',
        b"\xff\xfe1\x00",
        b"\xef\xbb\xbf1",
        b"[" * 60_000,
        b'{"value":' * 7000,
        b'"' + b"A" * 65_536 + b'"',
    ],
)
def test_any_other_payload_is_a_bad_value(sent: bytes) -> None:
    with pytest.raises(BadValue):
        parse_write(sent)


@given(st.binary(max_size=64))
@settings(max_examples=300)
def test_any_bytes_are_a_value_or_a_bad_value(sent: bytes) -> None:
    try:
        found = parse_write(sent)
    except BadValue:
        return
    assert isinstance(found, (bool, int, float, str, tuple))


@pytest.mark.parametrize(
    ("error", "word", "code"),
    [
        (BadValue("too large"), "bad-value", None),
        (Refused("no such area", code="28"), "refused", "28"),
        (NoReply("silence"), "unclear", None),
        (Garbled("noise"), "unclear", None),
        (Unclear("who knows"), "unclear", None),
        (LineDown("no port"), "line-down", None),
        (Busy("later"), "busy", None),
        (GatewayError("something new"), "unclear", None),
    ],
)
def test_every_error_has_its_word(error: GatewayError, word: str, code: str | None) -> None:
    document = json.loads(payload.outcome(payload.failure(error)))
    assert document == {"error": word, "code": code, "reason": str(error)}


def test_the_answer_to_a_write() -> None:
    document = json.loads(payload.outcome(WriteResult(12.5, NOON, 0.0310001, verified=True)))
    assert document == {
        "value": 12.5,
        "time": "2026-11-20T12:00:00.123456Z",
        "verified": True,
        "acknowledged": True,
        "took": 0.031,
    }


def test_an_answer_is_short_and_utf8_for_any_request() -> None:
    endless = Failure(Problem.BAD_VALUE, "\ud800" + "x" * 60_000)
    assert len(payload.outcome(endless)) < 500


@pytest.mark.parametrize(
    "requested", [None, True, 12, 12.5, "AB", 10**400, -(10**30), "x" * 60_000]
)
def test_the_audit_line_is_written_for_every_requested_value(requested: Value | None) -> None:
    failure = Failure(Problem.BUSY, "later")
    outcome = WriteOutcome("plant/mixer/recipe", requested, failure, NOON, 0.01)
    document = json.loads(payload.write_outcome(outcome))
    assert document["outcome"] == "busy"
    assert document["key"] == "plant/mixer/recipe"
    assert len(str(document["value"])) < 400


def test_a_document_with_the_name_of_a_file_that_is_no_text_is_text() -> None:
    found = payload.document({Problem.BUSY: 1, "file": "/x\udcff/plant.yaml"})
    assert json.loads(found) == {"busy": 1, "file": "/x?/plant.yaml"}
