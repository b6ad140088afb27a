"""Acknowledgements: who may, what is answered, and what is recorded."""

import asyncio
import json
import time
from pathlib import Path
from typing import Any

import pytest

from gateway.contract.access.signatures import sign
from gateway.contract.access.writers import Writers
from gateway.contract.keys import Family, Keys, parse_key, part_of
from gateway.contract.problems import Failure
from gateway.line.send_permit import SendPermit
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.commands import Orders
from gateway.parts.alarms.documents import open_alarms
from gateway.parts.alarms.machine import State
from gateway.tags import AlarmRule, Level, Reason, bad, good
from gateway.tags.timestamps import rfc3339
from tests.northbound.plant import PlainDevice, PlainPlant, gateway_and_client, tag

KEYS = Keys("plant", "demo")
KEY = KEYS.status("alarms/mixer/speed")
SPEED = tag("mixer", "speed", alarm=AlarmRule({Level.HIGH: 80}, text="too fast"))
SECRET = "Zm9vYmFyYmF6cXV4Zm9vYmFyYmF6cXV4"  # noqa: S105  (of a test)


class Desk:
    """A plant with one alarm, and its acknowledgements."""

    def __init__(self, writers: Writers | None = None) -> None:
        self.plant = PlainPlant(PlainDevice("mixer", (SPEED,)))
        self.audited: list[dict[str, Any]] = []
        audit = Audit(lambda data: self.audited.append(json.loads(data)))
        acceptance = Acceptance(SendPermit(), writers)
        self._desk = Orders(KEYS, self.plant.parts, audit, acceptance)

    def take(self, value: float) -> None:
        self.plant.samples["mixer/speed"] = sample = good(SPEED, value, time.time_ns())
        self.plant.alarms.judge([sample])

    async def acknowledge(
        self, data: bytes = b'{"by": "Ana"}', key: str = KEY, attachment: bytes | None = None
    ) -> Any:
        sender = Sender("5e55", attachment, asyncio.get_running_loop().time())
        result = await self._desk.execute("alarms", key, data, sender)
        return result if isinstance(result, Failure) else json.loads(result)


async def test_an_acknowledgement_is_answered_with_the_alarm_and_a_repeat_with_the_same() -> None:
    desk = Desk()
    desk.take(85)
    first = await desk.acknowledge()
    assert (first["state"], first["value"], first["text"]) == ("acknowledged", 85, "too fast")
    assert (first["acknowledged"]["by"], first["acknowledged"]["via"]) == ("Ana", "5e55")
    assert (await desk.acknowledge()) == first
    assert desk.audited == []


@pytest.mark.parametrize(
    ("data", "key", "error"),
    [
        (b'{"by": "Ana"}', KEY, "nothing-to-acknowledge"),
        (b'{"by": "Ana"}', KEYS.status("alarms/mixer/none"), "unknown-tag"),
        (b'{"by": "Ana"}', KEYS.status("alarms/mixer/*"), "bad-value"),
        (b"", KEY, "bad-value"),
        (b"[]", KEY, "bad-value"),
        (b'{"by": " "}', KEY, "bad-value"),
        (b'{"by": "a\\u001b[2J"}', KEY, "bad-value"),
        (b'{"by": "Ana", "all": true}', KEY, "bad-value"),
        (b'{"by": "%b"}' % (b"a" * 101), KEY, "bad-value"),
        (b'{"by": "Ana", "raised": 5}', KEY, "bad-value"),
        (b" " * 2001, KEY, "bad-value"),
    ],
)
async def test_each_refusal_has_its_word_and_is_audited(data: bytes, key: str, error: str) -> None:
    desk = Desk()
    refused = await desk.acknowledge(data, key)
    assert refused.problem == error
    assert [one["outcome"] for one in desk.audited] == [error]
    assert desk.plant.alarms.entries["mixer/speed"].status.state is State.NORMAL


async def test_an_alarm_that_was_raised_again_is_not_acknowledged() -> None:
    desk = Desk()
    desk.take(85)
    [seen] = open_alarms(desk.plant.alarms)
    raised = rfc3339(seen.status.raised)
    desk.take(70)
    desk.take(90)
    data = json.dumps({"by": "Ana", "raised": raised}).encode()
    assert (await desk.acknowledge(data)).problem == "nothing-to-acknowledge"
    assert seen.status.state is State.ACTIVE


async def test_with_writers_only_a_signed_acknowledgement_counts(tmp_path: Path) -> None:
    file = tmp_path / "writers.txt"
    file.write_text(f"hmi:{SECRET}\n")
    file.chmod(0o600)
    passed = iter((0.0, 60.0, 60.0, 60.0))
    writers = Writers(file, clock=lambda: next(passed))
    desk = Desk(writers)
    desk.take(85)
    data = b'{"by": "Ana"}'
    forged = sign("hmi", "x" * 30, rfc3339(time.time_ns()), KEY, data)
    for attachment in (None, forged):
        assert (await desk.acknowledge(data, attachment=attachment)).problem == "not-allowed"
    assert desk.plant.alarms.entries["mixer/speed"].status.state is State.ACTIVE
    signed = sign("hmi", SECRET, rfc3339(time.time_ns()), KEY, data)
    assert (await desk.acknowledge(data, attachment=signed))["acknowledged"]["via"] == "hmi"


def test_the_first_of_a_list_are_those_without_acknowledgement() -> None:
    tags = [tag("mixer", name, alarm=AlarmRule({Level.ON: 1.0})) for name in "abc"]
    plant = PlainPlant(PlainDevice("mixer", tuple(tags)))
    for alarm, state in zip(
        plant.alarms.entries.values(),
        (State.ACKNOWLEDGED, State.RETURNED, State.ACTIVE),
        strict=True,
    ):
        plant.alarms.restore({alarm.key: alarm.status._replace(state=state, level=Level.ON)})
    assert [entry.key for entry in open_alarms(plant.alarms)] == ["mixer/c", "mixer/b", "mixer/a"]


def test_keys_of_alarms() -> None:
    assert part_of("plant/@gateway/demo/alarms/mixer/speed") == "alarms"
    assert part_of("a/b/@gateway/*/alarms/**") == "alarms"
    assert part_of("plant/@gateway/demo/alarms") == ""
    assert parse_key("plant/@gateway/demo/alarms").family is Family.STATUS
    assert parse_key("plant/@gateway/demo/**").family is Family.STATUS


async def test_changes_are_published_and_queries_give_all() -> None:
    plant = PlainPlant(PlainDevice("mixer", (SPEED,)), PlainDevice("oven", (tag("oven", "t"),)))
    async with gateway_and_client(plant) as (_, client):
        changes = await client.subscribe("plant/@gateway/demo/alarms/**")
        plant.alarms.judge([plant.now("mixer/speed", 85)])
        active = (await changes.next(lambda one: one.json["state"] == "active")).json
        plant.samples["mixer/speed"] = bad(SPEED, Reason.NO_REPLY, time.time_ns())
        plant.alarms.judge([plant.samples["mixer/speed"]])
        held = await changes.next(lambda one: one.json.get("reason") == "no-reply")
        shown = held.json
        assert (shown["state"], shown["value"], shown["quality"]) == ("active", None, "bad")
        assert shown["value_at_change"] == active["value"] == 85
        assert [one.key for one in await client.get("plant/@gateway/*/alarms/**")] == [KEY]
        [reply] = await client.get(f"{KEY}?_time=[..]")
        assert reply.json["error"] == "no-history"


def test_each_change_is_in_history() -> None:
    class Recorded:
        def __init__(self) -> None:
            self.rows: list[Any] = []

        def record_alarm(self, time: int, change: str) -> None:
            self.rows.append((time, json.loads(change)))

    plant, history = PlainPlant(PlainDevice("mixer", (SPEED,))), Recorded()
    as_history: Any = history
    plant.parts.kept = as_history
    entry = plant.alarms.entries["mixer/speed"]
    entry.alarm.restore(entry.status._replace(state=State.ACTIVE, level=Level.HIGH, raised=1))
    plant.alarms.acknowledge("mixer/speed", "Ana")
    [(at, row)] = history.rows
    assert (row["event"], row["state"], row["since"]) == (
        "acknowledged",
        "acknowledged",
        rfc3339(at),
    )
    assert not row.keys() & {"by", "via", "change"}  # `acknowledged` has them
