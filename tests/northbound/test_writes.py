"""Writes over Zenoh: answered, refused with a word, bounded, and audited."""

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from gateway.config import ZenohConfig
from gateway.contract.keys import Keys
from gateway.errors import (
    BadValue,
    Busy,
    GatewayError,
    LineDown,
    NoReply,
    Refused,
)
from gateway.line.send_permit import SendPermit
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests import inbox
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import MOST_WAITING, OwnWrites, Writes
from tests.northbound.plant import (
    gateway_and_client,
    mixer,
    serving,
    until,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint


async def test_a_write_is_answered_on_its_own_key_with_what_was_acknowledged() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (_, client):
        audit = await client.subscribe("plant/@gateway/demo/writes")
        [reply] = await client.get("plant/mixer/recipe/@set", b'{"value": 7}')
        assert reply.ok
        assert reply.key == "plant/mixer/recipe/@set"
        assert reply.json["value"] == 7
        assert reply.json["verified"] is True
        assert reply.json["took"] == 0.031
        assert plant.written == [("mixer/recipe", 7)]
        line = (await audit.next(lambda _: True)).json
        assert (line["key"], line["value"], line["outcome"]) == ("plant/mixer/recipe", 7, "written")


async def test_a_write_with_target_all_is_done_once() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (_, client):
        replies = await client.get("plant/mixer/recipe/@set", b"7", target="ALL")
        assert [reply.ok for reply in replies] == [True]
        assert plant.written == [("mixer/recipe", 7)]


async def test_every_refused_write_has_its_error_word() -> None:
    plant = mixer()
    plant.endings = {
        1: Refused("there is no such address", code="28"),
        2: NoReply("no reply within 500 ms"),
        3: LineDown("the port is gone"),
        4: Busy("too many writes are waiting"),
        5: BadValue("not in this mode"),
        6: GatewayError("an unexpected error"),
        8: TimeoutError(),
    }
    recipe = "plant/mixer/recipe/@set"
    async with gateway_and_client(plant) as (_, client):
        for key, sent, word, code in (
            (recipe, b"1", "refused", "28"),
            (recipe, b"2", "unclear", None),
            (recipe, b"3", "line-down", None),
            (recipe, b"4", "busy", None),
            (recipe, b"5", "bad-value", None),
            (recipe, b"6", "unclear", None),
            (recipe, b"8", "unclear", None),
            (recipe, b"0", "bad-value", None),  # below min
            (recipe, b"4001", "bad-value", None),
            (recipe, b'"AB"', "bad-value", None),
            (recipe, b"1.5", "bad-value", None),
            (recipe, b"", "bad-value", None),
            (recipe, None, "bad-value", None),
            (recipe, b"NaN", "bad-value", None),
            (recipe, b"{", "bad-value", None),
            (recipe, b"[" * 60_000, "bad-value", None),
            (recipe, b"9" * 60_000, "bad-value", None),
            (recipe, b"7" + b" " * 70_000, "bad-value", None),
            ("plant/mixer/speed/@set", b"7", "not-writable", None),
            ("plant/mixer/nothing/@set", b"7", "unknown-tag", None),
            ("plant/mixer/@set", b"7", "bad-value", None),  # no object
            ("plant/mixer/*/@set", b"7", "unknown-tag", None),
            ("plant/mixer/**/@set", b"7", "unknown-tag", None),
        ):
            [reply] = await client.get(key, sent)
            assert not reply.ok
            assert reply.encoding == "application/json"
            assert (reply.json["error"], reply.json["code"]) == (word, code), (key, sent)
            assert reply.json["reason"]
        for reply in await client.get("plant/**/@set", b"7"):
            assert reply.json["error"] == "unknown-tag"
        assert await client.get("plant/unknown/recipe/@set", b"7") == []
    assert plant.written == []


async def test_a_write_that_ends_in_a_bug_is_unclear_and_the_next_one_works() -> None:
    plant = mixer()
    plant.endings = {9: KeyError("a bug")}
    async with gateway_and_client(plant) as (_, client):
        [reply] = await client.get("plant/mixer/recipe/@set", b"9")
        assert reply.json["error"] == "unclear"
        [reply] = await client.get("plant/mixer/recipe/@set", b"10")
        assert reply.ok


async def test_a_thousand_writes_at_once_are_bounded_and_each_is_answered() -> None:
    plant = mixer()
    plant.gate.clear()
    async with gateway_and_client(plant) as (northbound, client):
        asking = asyncio.create_task(
            client.many([("plant/mixer/recipe/@set", b"%d" % (10 + n)) for n in range(1000)])
        )
        # Values are read meanwhile: writes that wait hold up nothing else.
        [reply] = await get_with_another_client(client)
        assert reply.ok
        await until(lambda: northbound.counters()["queries"] == 1000 + 1)
        plant.gate.set()
        answers = await asking
        assert all(len(replies) == 1 for replies in answers)
        done = [replies[0] for replies in answers if replies[0].ok]
        words = {replies[0].json["error"] for replies in answers if not replies[0].ok}
        assert words == {"busy"}
        assert len(plant.written) == len(done) == MOST_WAITING


async def get_with_another_client(client: ZenohPeer) -> Sequence[Any]:
    """A `get` through a second process: the first one waits for its writes."""
    async with ZenohPeer("client", connect=client.connect) as other:
        return await other.get("plant/mixer/speed")


async def test_a_put_writes_too_and_its_outcome_is_published() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (_, client):
        audit = await client.subscribe("plant/@gateway/demo/writes")
        await client.put("plant/mixer/recipe/@set", b"7")
        assert (await audit.next(lambda _: True)).json["outcome"] == "written"
        audit.forget()
        await client.delete("plant/mixer/recipe/@set")  # a write of nothing
        assert (await audit.next(lambda _: True)).json["outcome"] == "bad-value"
        audit.forget()
        await client.put("plant/unknown/recipe/@set", b"7")
        for key, sent, word in (
            ("plant/mixer/recipe/@set", b"", "bad-value"),
            ("plant/**/@set", b"7", "unknown-tag"),
            ("plant/mixer/speed/@set", b"7", "not-writable"),
        ):
            await client.put(key, sent)
            line = (await audit.next(lambda _: True)).json
            assert line["outcome"] == word
            audit.forget()
        assert plant.written == [("mixer/recipe", 7)]


async def test_a_message_of_many_megabytes_is_dropped_and_the_link_stays_up() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (northbound, client):
        [reply] = await client.get("plant/mixer/recipe/@set", b"7" * 20_000_000, timeout=1)
        assert not reply.ok
        assert northbound.counters()["queries"] == 0  # it was never put together here
        [reply] = await client.get("plant/mixer/recipe/@set", b"7")
        assert reply.ok
        assert plant.written == [("mixer/recipe", 7)]


async def test_a_write_that_is_not_acknowledged_when_the_gateway_ends_is_unclear() -> None:
    plant = mixer()
    plant.gate.clear()
    endpoint = free_endpoint()
    async with ZenohPeer("peer", connect=[endpoint]) as client:
        async with serving(plant, ZenohConfig(listen=(endpoint,))) as northbound:
            live = await client.liveliness("plant/@gateway/*")
            await live.next(lambda token: token.kind == "PUT")
            asking = asyncio.create_task(client.get("plant/mixer/recipe/@set", b"7"))
            await until(lambda: northbound.counters()["queries"] == 1)
        [reply] = await asking
        assert reply.json["error"] == "unclear"


async def test_a_write_to_a_device_of_another_gateway_gets_no_reply_even_when_busy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A reply such as `busy` would say that nothing was done, but the other one may do it."""
    plant = mixer()
    plant.known_commands = {"oven": frozenset({"run"})}
    keys = ["plant/press/recipe/@set", "plant/press/@run"]
    async with gateway_and_client(plant) as (northbound, client):
        for key in keys:
            assert await client.get(key, b"7", timeout=60) == []
            await client.put(key, b"7")
        [reply] = await client.get("plant/mixer/nothing/@set", b"7")
        assert reply.json["error"] == "unknown-tag"
        monkeypatch.setattr(inbox, "LIMIT", 0)
        [reply] = await client.get("plant/mixer/recipe/@set", b"7")
        assert reply.json["error"] == "busy"
        for key in keys:
            assert await client.get(key, b"7", timeout=60) == []
        assert northbound.counters()["refused"] == 1
    assert plant.written == []
    assert plant.commanded == []


@pytest.mark.parametrize("dial", [0.0, 60.0])
async def test_a_write_may_wait_for_a_telephone_call(dial: float) -> None:
    plant = mixer()
    plant.dial = dial
    index = TagIndex(Keys("plant", "demo"), plant.devices(), plant.tag)
    writes = Writes(plant, index, lambda _: None, Acceptance(SendPermit(), None))
    arrived = asyncio.get_running_loop().time()
    await writes.write("plant/mixer/recipe/@set", b"7", Sender(arrived=arrived))
    assert plant.written == [("mixer/recipe", 7)]
    assert dial + 4 < plant.within <= dial + 5
    own = OwnWrites(Keys("plant", "demo"), plant, Audit(lambda _: None))
    tag = plant.tag("mixer/recipe")
    assert tag is not None
    await own.write(tag, 8, "transfer", within=2.0)
    assert plant.within == 2.0  # its value is too old after that, whatever the line
