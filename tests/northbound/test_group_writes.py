"""Several tags in one write: checked before anything is sent, one answer, one outcome for each."""

import asyncio
import json
from typing import Any

import pytest

from gateway.contract import payload
from gateway.contract.keys import Keys
from gateway.contract.parsing import LARGEST_GROUP, parse_group
from gateway.contract.payload import GroupResult, WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.errors import BadValue, Busy, NoReply, Refused
from gateway.line.send_permit import SendPermit
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests import writes
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.writes import Writes
from gateway.tags import WriteResult, WriteRule
from tests.northbound.plant import PlainDevice, PlainPlant, gateway_and_client, tag

RULE = WriteRule(min=0, max=4000)


def recipes() -> PlainPlant:
    tags = [tag("mixer", f"recipe/{letter}", write=RULE) for letter in "abcd"]
    return PlainPlant(PlainDevice("mixer", (*tags, tag("mixer", "speed"))))


class Rig:
    """The writes of one gateway without Zenoh, and their audit."""

    def __init__(self, plant: PlainPlant) -> None:
        keys = Keys("plant", "demo")
        self.plant = plant
        self.audit: list[WriteOutcome] = []
        index = TagIndex(keys, plant.devices(), plant.tag)
        accepts = Acceptance(SendPermit(), None)
        self.writes = Writes(plant, index, self.audit.append, accepts)

    def write(self, data: object, *, arrived: float | None = None) -> GroupResult | Failure:
        sent = data if isinstance(data, bytes) else json.dumps(data).encode()

        async def ask() -> GroupResult | Failure:
            at = asyncio.get_running_loop().time() if arrived is None else arrived
            sender = Sender("alice", None, at)
            result = await self.writes.write("plant/mixer/@set", sent, sender)
            assert not isinstance(result, WriteResult)
            return result

        return asyncio.run(ask())

    @property
    def outcomes(self) -> dict[str, str]:
        assert {one.by for one in self.audit} == {"alice"}
        return {one.key.removeprefix("plant/mixer"): payload.word(one.result) for one in self.audit}


def words(result: GroupResult | Failure) -> dict[str, str]:
    assert isinstance(result, GroupResult)
    return {name: payload.word(end) for name, end in result.tags.items()}


def test_all_tags_are_written_in_their_order_and_audited_each() -> None:
    rig = Rig(recipes())
    result = rig.write({"recipe/b": 2, "recipe/a": {"value": 1}, "recipe/d": 4})
    assert words(result) == dict.fromkeys(["recipe/b", "recipe/a", "recipe/d"], "written")
    assert rig.plant.written == [
        ("mixer/recipe/b", 2),
        ("mixer/recipe/a", 1),
        ("mixer/recipe/d", 4),
    ]
    assert rig.outcomes == dict.fromkeys(["/recipe/b", "/recipe/a", "/recipe/d"], "written")
    assert [one.value for one in rig.audit] == [2, 1, 4]
    assert payload.failed(result) is None
    answer = json.loads(payload.outcome(result))
    assert [*answer] == ["tags", "took"]
    assert [*answer["tags"]] == ["recipe/b", "recipe/a", "recipe/d"]
    assert answer["tags"]["recipe/a"]["value"] == 1


@pytest.mark.parametrize(
    ("data", "faults"),
    [
        (b'{"recipe/a": 1, "recipe/b": 4001}', {"recipe/b": "bad-value"}),
        (b'{"recipe/a": 1, "recipe/b": "x"}', {"recipe/b": "bad-value"}),
        (b'{"recipe/a": 1, "recipe/b": {"v": 1}}', {"recipe/b": "bad-value"}),
        (b'{"recipe/a": 1, "recipe/b": null}', {"recipe/b": "bad-value"}),
        (b'{"recipe/a": 1, "speed": 1}', {"speed": "not-writable"}),
        (b'{"recipe/a": 1, "recipe/z": 1}', {"recipe/z": "unknown-tag"}),
        (b'{"recipe/b": 1, "recipe/a": 1, "recipe/b": 1}', {"recipe/b": "bad-value"}),
        (
            b'{"": 1, "recipe/a": 1, "recipe/*": 1, "recipe/b": -1}',
            {"": "unknown-tag", "recipe/*": "unknown-tag", "recipe/b": "bad-value"},
        ),
    ],
)
def test_one_fault_and_nothing_is_sent_and_the_answer_names_each(
    data: bytes, faults: dict[str, str]
) -> None:
    rig = Rig(recipes())
    result = rig.write(data)
    found = words(result)
    assert {name: word for name, word in found.items() if word != "not-sent"} == faults
    assert found["recipe/a"] == "not-sent"
    assert rig.plant.written == []
    failed = payload.failed(result)
    assert failed is not None
    assert failed.problem.value == next(iter(faults.values()))
    assert all(f"{name}: " in failed.reason for name in faults)
    assert len(rig.audit) == len(parse_group(data))


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"7", b"[1]", b"{}", b"{", b'"a"', b'{"value": 1}}', b"\xff", b'{"\\ud800": 1}'),
        json.dumps({f"t{n}": 1 for n in range(LARGEST_GROUP + 1)}).encode(),
    ],
)
def test_a_payload_that_names_no_tags_is_refused_with_one_outcome(data: bytes) -> None:
    rig = Rig(recipes())
    result = rig.write(data)
    assert isinstance(result, Failure)
    assert result.problem is Problem.BAD_VALUE
    assert rig.outcomes == {"": "bad-value"}


def test_a_group_of_the_past_is_not_sent() -> None:
    rig = Rig(recipes())
    result = rig.write({"recipe/a": 1}, arrived=-1e9)
    assert isinstance(result, Failure)
    assert result.problem is Problem.BUSY
    assert rig.plant.written == []


def test_with_many_groups_waiting_the_next_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writes, "MOST_WAITING", 0)
    rig = Rig(recipes())
    result = rig.write({"recipe/a": 1})
    assert isinstance(result, Failure)
    assert result.problem is Problem.BUSY
    assert (rig.plant.written, rig.outcomes) == ([], {"": "busy"})


@pytest.mark.parametrize(
    ("endings", "expected", "whole"),
    [
        ({1: Refused("no", code="28")}, "refused not-sent not-sent", "refused"),
        ({2: Refused("no", code="28")}, "written refused not-sent", "incomplete"),
        ({2: NoReply("no reply")}, "written unclear not-sent", "unclear"),
        ({1: NoReply("no reply")}, "unclear not-sent not-sent", "unclear"),
        ({1: Busy("later")}, "busy not-sent not-sent", "busy"),
        ({3: BadValue("no")}, "written written bad-value", "incomplete"),
    ],
)
def test_the_answer_says_what_was_done_and_is_good_only_if_all_was(
    endings: dict[Any, Exception], expected: str, whole: str
) -> None:
    rig = Rig(recipes())
    rig.plant.endings = endings
    result = rig.write({"recipe/a": 1, "recipe/b": 2, "recipe/c": 3})
    assert " ".join(words(result).values()) == expected
    assert " ".join(rig.outcomes.values()) == expected
    failed = payload.failed(result)
    assert failed is not None
    assert failed.problem.value == whole
    assert failed.reason.startswith(f"{expected.split().count('written')} of 3 tags were written")


async def test_a_group_is_one_query_on_the_key_of_the_device_or_one_put() -> None:
    plant = recipes()
    async with gateway_and_client(plant) as (_, client):
        audit = await client.subscribe("plant/@gateway/demo/writes")
        [reply] = await client.get("plant/mixer/@set", b'{"recipe/a": 1, "recipe/b": 2}')
        assert reply.ok
        assert (reply.key, [*reply.json["tags"]]) == ("plant/mixer/@set", ["recipe/a", "recipe/b"])
        [reply] = await client.get("plant/mixer/@set", b'{"recipe/a": 1, "recipe/b": 4001}')
        assert not reply.ok
        assert (reply.json["error"], [*reply.json["tags"]]) == (
            "bad-value",
            ["recipe/a", "recipe/b"],
        )
        await client.put("plant/mixer/@set", b'{"recipe/c": 3, "recipe/d": 4}')
        await audit.next(lambda sample: sample.json["key"] == "plant/mixer/recipe/d")
        outcomes = [(one.json["key"][-1], one.json["outcome"]) for one in audit.samples]
        written = [(letter, "written") for letter in "abcd"]
        assert [one for one in outcomes if one[1] == "written"] == written
        assert len(outcomes) == 6


@pytest.mark.parametrize("text", ["a", "recipe/a", "ä"])
def test_a_group_keeps_names_and_values_in_their_order(text: str) -> None:
    data = json.dumps({"z": 1.5, text: [1, 2], "b": True}).encode()
    assert parse_group(data) == [("z", 1.5), (text, (1, 2)), ("b", True)]
