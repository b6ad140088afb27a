"""The gateway on Zenoh, seen by other processes: values, questions, writes, signs of life."""

import asyncio
import itertools
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from gateway.config import ZenohConfig, ZenohMode
from gateway.errors import (
    BadValue,
    Busy,
    ConfigError,
    GatewayError,
    LineDown,
    NoReply,
    Refused,
)
from gateway.northbound import Northbound, payload
from gateway.northbound.inbox import LIMIT, Inbox
from gateway.northbound.keys import Keys
from gateway.northbound.link_monitor import LinkMonitor
from gateway.northbound.publisher import EVENTS_LIMIT, Publisher
from gateway.northbound.republish import Republisher
from gateway.northbound.session import configure
from gateway.northbound.tag_index import TagIndex
from gateway.northbound.writes import MOST_WAITING
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Form, Reason, Sample, Tag, WriteResult, WriteRule, bad, good
from gateway.values import Layout, Value, parse_type
from tests.zenoh_peer import ZenohPeer, free_endpoint

NONE = "NONE"  # Zenoh's consolidation that streams


# -- a plant of plain data ---------------------------------------------------------------------


def tag(device: str, name: str, **settings: Any) -> Tag:
    return Tag(
        device=device,
        name=name,
        text="D100",
        address=Address("D", 100),
        span=Span("D", 100, 1),
        unit_kind=Unit.WORD,
        layout=Layout(parse_type("int16")),
        **settings,
    )


@dataclass(frozen=True)
class PlainDevice:
    name: str
    tags: tuple[Tag, ...]
    blocks: bool | Literal["only"] = False


class PlainPlant:
    """Samples in a dict. A write is acknowledged, or ends as `endings` says for its value."""

    def __init__(self, *devices: PlainDevice) -> None:
        self._devices = devices
        self._tags = {tag.key: tag for device in devices for tag in device.tags}
        self.samples = {
            key: bad(tag, Reason.STARTING, time.time_ns()) for key, tag in self._tags.items()
        }
        self.endings: dict[Value, Exception] = {}
        self.gate = asyncio.Event()  # writes wait for it
        self.gate.set()
        self.written: list[tuple[str, Value]] = []
        self.read: list[str] = []
        self.unread: set[str] = set()  # that the line does not get to
        self.repeated: list[Sample] = []

    def devices(self) -> Iterable[PlainDevice]:
        return self._devices

    def tag(self, key: str) -> Tag | None:
        return self._tags.get(key)

    def sample(self, tag: Tag) -> Sample:
        return self.samples[tag.key]

    async def write(self, tag: Tag, value: Value) -> WriteResult:
        tag.encode(value)
        await self.gate.wait()
        if value in self.endings:
            raise self.endings[value]
        self.written.append((tag.key, value))
        return WriteResult(value, time.time_ns(), verified=True, took=0.031)

    def told(self, samples: Sequence[Sample]) -> None:
        self.repeated += samples

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        return time.time_ns() - self.samples[tag.key].time < max_age * 1e9

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        if not self.is_fresh(tag, max_age):
            self.read.append(tag.key)
            if tag.key in self.unread:
                raise Busy(f"{tag.key} could not be read")
            self.samples[tag.key] = good(tag, 4711, time.time_ns())
        return self.samples[tag.key]

    def status(self) -> Mapping[str, Mapping[str, object]]:
        return {"status": {"state": "running"}, "lines/hall-1": {"load": 0.5}}

    def now(self, key: str, value: Value) -> Sample:
        """A new sample, already current."""
        self.samples[key] = good(self._tags[key], value, time.time_ns())
        return self.samples[key]


def mixer(*, blocks: bool | Literal["only"] = False) -> PlainPlant:
    return PlainPlant(
        PlainDevice(
            "mixer",
            (
                tag("mixer", "speed", unit="rpm"),
                tag("mixer", "alarms/door", description="Guard door open"),
                tag("mixer", "recipe", write=WriteRule(min=1, max=4000)),
            ),
            blocks,
        ),
        PlainDevice("oven", (tag("oven", "temperature"),)),
    )


@asynccontextmanager
async def serving(plant: PlainPlant, settings: ZenohConfig) -> AsyncIterator[Northbound]:
    northbound = Northbound(settings, "demo", plant, status_every=0.5)
    serves = asyncio.create_task(northbound.run())
    opens = asyncio.create_task(northbound.opened.wait())
    await asyncio.wait([serves, opens], return_when=asyncio.FIRST_COMPLETED, timeout=5)
    try:
        if serves.done():
            serves.result()
        yield northbound
    finally:
        opens.cancel()
        serves.cancel()
        await asyncio.wait([serves], timeout=5)
        assert serves.done()


@asynccontextmanager
async def together(
    plant: PlainPlant,
) -> AsyncIterator[tuple[Northbound, ZenohPeer]]:
    """A gateway that listens, and a client in another process."""
    endpoint = free_endpoint()
    async with (
        serving(plant, ZenohConfig(listen=(endpoint,))) as northbound,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        yield northbound, client


def of(key: str, value: Value | None) -> Any:
    return lambda heard: heard.key == key and heard.json["value"] == value


# -- values ------------------------------------------------------------------------------------


async def test_a_published_value_arrives_as_the_contract_says() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
        heard = await client.subscribe("plant/**")
        sample = plant.now("mixer/speed", 12)
        northbound.publish([sample])
        arrived = await heard.next(of("plant/mixer/speed", 12))
        assert arrived.encoding == "application/json"
        assert set(arrived.json) == {"value", "quality", "time"}
        # What lies under @ is not heard by a subscriber of values.
        assert not any("@" in sample.key for sample in heard.samples)


async def test_values_leave_in_the_order_of_their_stamps() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
        heard = await client.subscribe("plant/**")
        for value in range(300):
            northbound.publish([plant.now("mixer/speed", value), plant.now("mixer/recipe", value)])
            if value % 7 == 0:
                await asyncio.sleep(0)
        await heard.next(of("plant/mixer/recipe", 299))
        stamps = [sample.time for sample in heard.samples]
        assert stamps == sorted(stamps)
        counters = northbound.counters()
        # Nothing is lost but what a newer value replaced. Beside the 600: the first publication.
        assert counters["superseded"] + len(heard.samples) in range(600, 605)


class StuckSession:
    """As much of a session as the publisher uses; its first put hangs until `go` is set."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.hangs = threading.Event()
        self.puts: list[tuple[int, str, Any]] = []
        self._clock = itertools.count()

    def new_timestamp(self) -> int:
        return next(self._clock)

    def put(self, key: str, data: bytes, *, timestamp: int, **_how: object) -> None:
        self.hangs.set()
        assert self.go.wait(5)
        self.puts.append((timestamp, key, json.loads(data)["value"]))


async def test_a_stuck_network_costs_old_values_never_the_newest_nor_the_order() -> None:
    plant = mixer()
    session: Any = StuckSession()
    publisher = Publisher(Keys("plant", "demo"))
    publisher.start(session)
    publisher.values([plant.now("mixer/speed", 0)])
    await asyncio.to_thread(session.hangs.wait, 5)
    publisher.values([plant.now("mixer/speed", 1), plant.now("mixer/recipe", 10)])
    publisher.events([plant.now("oven/temperature", value) for value in (100, 101)])
    for value in range(2, 20_000):
        publisher.values([plant.now("mixer/speed", value)])
    session.go.set()
    await asyncio.to_thread(publisher.stop, 5)
    speed, recipe, oven = "plant/mixer/speed", "plant/mixer/recipe", "plant/oven/temperature"
    assert [(key, value) for _, key, value in session.puts] == [
        (speed, 0),
        (recipe, 10),
        (oven, 100),
        (oven, 101),
        (speed, 19_999),
    ]
    assert session.puts == sorted(session.puts)  # by their stamps
    assert publisher.counters.superseded == 19_998
    assert publisher.counters.published == 5


async def test_events_beyond_the_limit_are_dropped_and_counted() -> None:
    plant = mixer()
    session: Any = StuckSession()
    publisher = Publisher(Keys("plant", "demo"))
    publisher.events([plant.now("mixer/speed", 0)])  # no session yet
    publisher.start(session)
    publisher.values([plant.now("mixer/recipe", 0)])
    await asyncio.to_thread(session.hangs.wait, 5)
    publisher.events(plant.now("mixer/speed", value) for value in range(EVENTS_LIMIT + 5))
    session.go.set()
    await asyncio.to_thread(publisher.stop, 5)
    assert publisher.counters.dropped == 6
    assert [value for *_, value in session.puts] == [0, *range(EVENTS_LIMIT)]


@pytest.mark.parametrize("event", [False, True])
async def test_a_bad_value_is_repeated_with_its_heartbeat_and_keeps_its_time(event: bool) -> None:
    repeated = tag("mixer", "speed", heartbeat=0.5, event=event)
    plant = PlainPlant(PlainDevice("mixer", (repeated, tag("mixer", "level"))))
    async with together(plant) as (northbound, client):
        speed, level = (plant.tag(f"mixer/{name}") for name in ("speed", "level"))
        assert speed is not None
        assert level is not None
        heard = await client.subscribe("plant/mixer/*")
        down = [bad(of, Reason.NO_REPLY, time.time_ns()) for of in (speed, level)]
        plant.samples |= {sample.tag.key: sample for sample in down}
        northbound.publish(down)
        await heard.next(lambda sample: sample.key.endswith("level"))
        told = await heard.next(lambda sample: sample.key.endswith("speed"))
        heard.forget()
        for _ in range(2):
            again = await heard.next(lambda _: True)
            assert again.key == "plant/mixer/speed"  # the other has no heartbeat
            assert again.json == told.json
            heard.forget()
        northbound.publish([plant.now("mixer/speed", 7)])
        assert (await heard.next(lambda _: True)).json["value"] == 7


async def test_events_all_arrive_in_order() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
        heard = await client.subscribe("plant/mixer/speed")
        northbound.publish_events(plant.now("mixer/speed", value) for value in range(500))
        await heard.next(of("plant/mixer/speed", 499))
        values = [sample.json["value"] for sample in heard.samples]
        assert [value for value in values if value is not None] == list(range(500))


async def test_an_event_is_told_once_and_that_nothing_is_known_of_it_as_often_as_all_else() -> None:
    code, weight = tag("reader", "code", event=True), tag("reader", "weight")
    plant = PlainPlant(PlainDevice("reader", (code, weight)))
    directory = TagIndex(Keys("plant", "demo"), plant.devices())
    told: list[Sample] = []
    repeater = Republisher(told.extend, plant, directory, LinkMonitor())
    await repeater.publish_all()  # as at a start
    assert told == [bad(of, Reason.STARTING, plant.sample(of).time) for of in (code, weight)]
    told.clear()
    plant.now("reader/code", 4711)
    heavy = plant.now("reader/weight", 12)
    await repeater.publish_all()
    assert told == [heavy]
    told.clear()
    gone = plant.samples["reader/code"] = bad(code, Reason.LINE_DOWN, time.time_ns())
    await repeater.publish_all()
    assert told == [gone, heavy]


async def test_the_plant_is_told_what_is_published_again_before_it_is() -> None:
    plant, told = mixer(), list[Sample]()

    def publish(samples: Sequence[Sample]) -> None:
        told.extend(samples)
        assert plant.repeated == told

    directory = TagIndex(Keys("plant", "demo"), plant.devices())
    await Republisher(publish, plant, directory, LinkMonitor()).publish_all()
    assert len(told) == 4


async def test_a_scan_of_a_device_with_blocks_is_one_put() -> None:
    plant = mixer(blocks=True)
    async with together(plant) as (northbound, client):
        heard = await client.subscribe("plant/*/@block")
        northbound.publish(
            [
                plant.now("mixer/speed", 1),
                plant.now("mixer/recipe", 2),
                plant.now("oven/temperature", 3),
            ]
        )
        block = await heard.next(lambda sample: True)
        assert block.key == "plant/mixer/@block"
        assert {name: entry["value"] for name, entry in block.json.items()} == {
            "speed": 1,
            "recipe": 2,
        }
        [reply] = await client.get("plant/*/@block")
        assert set(reply.json) == {"speed", "recipe", "alarms/door"}


async def test_a_device_that_says_blocks_only_puts_no_single_values() -> None:
    plant = mixer(blocks="only")
    async with together(plant) as (northbound, client):
        heard = await client.subscribe("plant/**")
        block = await client.subscribe("plant/mixer/@block")
        northbound.publish([plant.now("mixer/speed", 1), plant.now("oven/temperature", 3)])
        scan = await block.next(lambda sample: sample.json["speed"]["value"] == 1)
        assert set(scan.json) >= {"speed"}
        await heard.next(of("plant/oven/temperature", 3))
        assert not [sample.key for sample in heard.samples if "mixer" in sample.key]
        # Asked for they are, but not by who would then wait for news.
        [reply] = await client.get("plant/mixer/speed")
        assert reply.json["value"] == 1
        late = await client.subscribe("plant/**", advanced=True)
        await late.next(of("plant/oven/temperature", 3))
        assert not [sample.key for sample in late.samples if "mixer" in sample.key]


async def test_a_raw_value_travels_bare_and_its_quality_beside_it() -> None:
    raw = PlainPlant(PlainDevice("mixer", (tag("mixer", "speed", payload=Form.RAW),)))
    async with together(raw) as (northbound, client):
        heard = await client.subscribe("plant/**")
        northbound.publish([raw.now("mixer/speed", 12)])
        arrived = await heard.next(lambda sample: sample.payload == b"12")
        assert (arrived.kind, arrived.encoding) == ("PUT", "text/plain")
        beside = json.loads(arrived.attachment)
        assert set(beside) == {"quality", "time"}
        assert beside["quality"] == "good"
        [reply] = await client.get("plant/mixer/speed")
        assert (reply.payload, reply.encoding) == (b"12", "text/plain")
        # What is not known is no text that could be taken for a value.
        heard.forget()
        speed = raw.tag("mixer/speed")
        assert speed is not None
        raw.samples["mixer/speed"] = bad(speed, Reason.NO_REPLY, time.time_ns())
        northbound.publish([raw.samples["mixer/speed"]])
        gone = await heard.next(lambda sample: True)
        assert (gone.kind, gone.payload) == ("DELETE", b"")
        beside = json.loads(gone.attachment)
        assert (beside["quality"], beside["reason"]) == ("bad", "no-reply")
        [reply] = await client.get("plant/mixer/speed")
        assert (reply.ok, reply.payload) == (True, b"")
        [described] = await client.get("plant/mixer/speed/@meta")
        assert described.json["payload"] == "raw"


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, b"true"), (False, b"false"), (-7, b"-7"), (12.5, b"12.5"), ("Ä 1", "Ä 1".encode()),
     (2**63, b"9223372036854775808"), (math.nan, None), (math.inf, None), (None, None)],
)  # fmt: skip
def test_raw_texts(value: Any, text: bytes | None) -> None:
    sample = good(tag("mixer", "speed"), value, 0)
    assert payload.value_text(sample) == text
    assert (json.loads(payload.attachment(sample))["quality"] == "good") == (text is not None)


# -- questions ---------------------------------------------------------------------------------


async def test_ten_thousand_current_values_by_one_wildcard_get() -> None:
    devices = [
        PlainDevice(f"d{d}", tuple(tag(f"d{d}", f"t{t}") for t in range(500))) for d in range(20)
    ]
    plant = PlainPlant(*devices)
    for number, key in enumerate(plant.samples):
        plant.now(key, number)
    async with together(plant) as (_, client):
        for selector, count in (
            ("plant/**", 10_000),
            ("**", 10_000),
            ("plant/d7/*", 500),
            ("plant/*/t3", 20),
            ("plant/d1$*/t3", 11),
            ("plant/d7/t3", 1),
            ("plant/nobody/t3", 0),
        ):
            replies = await client.get(selector, consolidation=NONE)
            assert len({reply.key for reply in replies}) == len(replies) == count, selector
            for reply in replies:
                assert reply.key is not None
                assert reply.json["value"] == plant.samples[reply.key[6:]].value
        stamps = [reply.time for reply in await client.get("plant/d7/*", consolidation=NONE)]
        assert len(set(stamps)) == 500


async def test_a_late_advanced_subscriber_gets_every_last_value_and_goes_on() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
        northbound.publish([plant.now("mixer/speed", 1), plant.now("oven/temperature", 200)])
        heard = await client.subscribe("plant/**", advanced=True)
        await heard.until(lambda of: len(of.latest()) == 4)
        assert heard.latest()["plant/oven/temperature"].json["value"] == 200
        assert heard.latest()["plant/mixer/recipe"].json["reason"] == "starting"
        for value in range(2, 50):
            northbound.publish([plant.now("mixer/speed", value), plant.now("mixer/recipe", value)])
            await asyncio.sleep(0.001)
        await heard.next(of("plant/mixer/speed", 49))
        await heard.next(of("plant/mixer/recipe", 49))


async def test_a_browser_finds_every_tag_by_its_meta() -> None:
    async with together(mixer()) as (_, client):
        for selector, count in (
            ("plant/**/@meta", 4),
            ("**/@meta", 4),
            ("plant/*/*/@meta", 3),
            ("plant/mixer/**/@meta", 3),
            ("plant/mixer/alarms/door/@meta", 1),
            ("plant/mixer/nothing/@meta", 0),
        ):
            assert len(await client.get(selector)) == count, selector
        [reply] = await client.get("plant/mixer/alarms/door/@meta")
        assert reply.key == "plant/mixer/alarms/door/@meta"
        assert reply.json["description"] == "Guard door open"
        assert reply.json["write"] is None


async def test_status_is_answered_and_published() -> None:
    async with together(mixer()) as (_, client):
        keys = {reply.key for reply in await client.get("plant/@gateway/*/**")}
        own = "plant/@gateway/demo"
        assert keys == {f"{own}/status", f"{own}/lines/hall-1", f"{own}/zenoh"}
        [reply] = await client.get(f"{own}/lines/*")
        assert reply.json == {"load": 0.5}
        heard = await client.subscribe("plant/@gateway/*/status")
        assert (await heard.next(lambda _: True)).json == {"state": "running"}


async def test_max_age_reads_the_device_unless_the_sample_is_younger() -> None:
    plant = mixer()
    plant.now("mixer/speed", 12)
    async with together(plant) as (_, client):
        [reply] = await client.get("plant/mixer/speed?max_age=1min")
        assert reply.json["value"] == 12
        assert plant.read == []
        [reply] = await client.get("plant/mixer/speed?max_age=0s")
        assert reply.json["value"] == 4711
        assert len(await client.get("plant/mixer/**?max_age=0s")) == 3
        assert sorted(plant.read) == [
            "mixer/alarms/door",
            "mixer/recipe",
            "mixer/speed",
            "mixer/speed",
        ]
        [reply] = await client.get("plant/mixer/speed?max_age=soon")
        assert reply.json["error"] == "bad-query"
        assert await client.get("plant/nobody/speed?max_age=soon") == []


async def test_what_cannot_be_read_takes_no_other_value_away() -> None:
    plant = mixer()
    plant.unread = {"mixer/recipe"}
    async with together(plant) as (_, client):
        *values, error = sorted(await client.get("plant/**?max_age=0s"), key=lambda of: not of.ok)
        assert {reply.key: reply.json["value"] for reply in values} == {
            "plant/mixer/speed": 4711,
            "plant/mixer/alarms/door": 4711,
            "plant/oven/temperature": 4711,
        }
        assert error.json == {
            "error": "busy",
            "reason": "mixer/recipe could not be read in time",
            "code": None,
        }
        plant.unread |= {"mixer/speed", "mixer/alarms/door"}
        [error] = await client.get("plant/mixer/*?max_age=0s")
        assert error.json["reason"].endswith(" and 1 more could not be read in time")


async def test_what_gets_too_old_while_another_is_read_is_read_too() -> None:
    class Slow(PlainPlant):
        """Reading the speed takes so long that nothing else is young after it."""

        def is_fresh(self, tag: Tag, max_age: float) -> bool:
            return "mixer/speed" not in self.read and tag.name != "speed"

        async def fresh(self, tag: Tag, max_age: float) -> Sample:
            if tag.name == "speed":
                await asyncio.sleep(0)
            return await super().fresh(tag, max_age)

    plant = Slow(*mixer().devices())
    async with together(plant) as (_, client):
        replies = await client.get("plant/mixer/*?max_age=1s")
        assert {reply.json["value"] for reply in replies} == {4711}
        assert plant.read == ["mixer/speed", "mixer/recipe"]  # each once


async def test_what_turned_bad_after_it_was_read_is_answered_bad_whatever_the_clock_says() -> None:
    class Failing(PlainPlant):
        async def fresh(self, tag: Tag, max_age: float) -> Sample:
            read = await super().fresh(tag, max_age)
            an_hour_back = read.time - 3600 * 10**9
            self.samples[tag.key] = bad(tag, Reason.NO_REPLY, an_hour_back)
            return read

    async with together(Failing(*mixer().devices())) as (_, client):
        [reply] = await client.get("plant/mixer/speed?max_age=0s")
        assert (reply.json["value"], reply.json["reason"]) == (None, "no-reply")


async def test_a_question_of_the_past_is_refused_where_no_history_is_kept() -> None:
    async with together(mixer()) as (_, client):
        for selector in ("plant/mixer/speed?_time=[now(-1h)..]", "plant/**?_time=[..]"):
            [reply] = await client.get(selector)
            assert not reply.ok
            assert reply.json["error"] == "no-history"
        assert await client.get("plant/nobody/speed?_time=[..]") == []


# -- writes ------------------------------------------------------------------------------------


async def test_a_write_is_answered_on_its_own_key_with_what_was_acknowledged() -> None:
    plant = mixer()
    async with together(plant) as (_, client):
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


async def test_a_write_asked_of_all_is_done_once() -> None:
    plant = mixer()
    async with together(plant) as (_, client):
        replies = await client.get("plant/mixer/recipe/@set", b"7", target="ALL")
        assert [reply.ok for reply in replies] == [True]
        assert plant.written == [("mixer/recipe", 7)]


async def test_every_refusal_of_a_write_has_its_word() -> None:
    plant = mixer()
    plant.endings = {
        1: Refused("there is no such address", code="28"),
        2: NoReply("no reply within 500 ms"),
        3: LineDown("the port is gone"),
        4: Busy("too many writes are waiting"),
        5: BadValue("not in this mode"),
        6: GatewayError("nobody foresaw this"),
        8: TimeoutError(),
    }
    recipe = "plant/mixer/recipe/@set"
    async with together(plant) as (_, client):
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
            ("plant/mixer/@set", b"7", "unknown-tag", None),
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
        assert await client.get("plant/nobody/recipe/@set", b"7") == []
    assert plant.written == []


async def test_a_write_that_fails_in_an_unforeseen_way_is_unclear_and_harms_nobody() -> None:
    plant = mixer()
    plant.endings = {9: KeyError("a bug")}
    async with together(plant) as (_, client):
        [reply] = await client.get("plant/mixer/recipe/@set", b"9")
        assert reply.json["error"] == "unclear"
        [reply] = await client.get("plant/mixer/recipe/@set", b"10")
        assert reply.ok


async def test_a_thousand_writes_at_once_are_bounded_and_each_is_answered() -> None:
    plant = mixer()
    plant.gate.clear()
    async with together(plant) as (_, client):
        asking = asyncio.create_task(
            client.many([("plant/mixer/recipe/@set", b"%d" % (10 + n)) for n in range(1000)])
        )
        # Values are read meanwhile: writes that wait hold up nothing else.
        [reply] = await client_of_its_own(client)
        assert reply.ok
        plant.gate.set()
        answers = await asking
        assert all(len(replies) == 1 for replies in answers)
        done = [replies[0] for replies in answers if replies[0].ok]
        words = {replies[0].json["error"] for replies in answers if not replies[0].ok}
        assert words == {"busy"}
        assert len(plant.written) == len(done) == MOST_WAITING


async def client_of_its_own(client: ZenohPeer) -> Sequence[Any]:
    """A `get` through a second process: the first one waits for its writes."""
    async with ZenohPeer("client", connect=client.connect) as other:
        return await other.get("plant/mixer/speed")


async def test_a_put_writes_too_and_its_outcome_is_told() -> None:
    plant = mixer()
    async with together(plant) as (_, client):
        audit = await client.subscribe("plant/@gateway/demo/writes")
        await client.put("plant/mixer/recipe/@set", b"7")
        assert (await audit.next(lambda _: True)).json["outcome"] == "written"
        audit.forget()
        await client.delete("plant/mixer/recipe/@set")  # a write of nothing
        assert (await audit.next(lambda _: True)).json["outcome"] == "bad-value"
        audit.forget()
        await client.put("plant/nobody/recipe/@set", b"7")
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


async def test_a_message_of_many_megabytes_ends_unheard_and_the_link_lives() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
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


async def until(true: Any) -> None:
    async with asyncio.timeout(5):
        while not true():
            await asyncio.sleep(0.005)


# -- the network comes and goes ----------------------------------------------------------------


@pytest.mark.parametrize("mode", [ZenohMode.PEER, ZenohMode.CLIENT])
async def test_after_a_router_was_killed_and_returned_everything_is_published_again(
    mode: ZenohMode,
) -> None:
    plant = mixer()
    endpoint = free_endpoint()
    # No router yet: the gateway starts all the same.
    northbound = Northbound(ZenohConfig(mode=mode, connect=(endpoint,)), "demo", plant)
    serves = asyncio.create_task(northbound.run())
    northbound.publish([plant.now("mixer/speed", 1)])
    try:
        async with (
            ZenohPeer("router", listen=[endpoint]) as router,
            ZenohPeer("client", connect=[endpoint]) as client,
        ):
            heard = await client.subscribe("plant/**")
            await heard.next(of("plant/mixer/speed", 1))
            live = await client.liveliness("plant/@gateway/*")
            await live.next(lambda token: token.kind == "PUT")
            await router.kill()
            heard.forget()
            live.forget()
            northbound.publish([plant.now("mixer/speed", 2)])  # nobody hears it
            async with ZenohPeer("router", listen=[endpoint]):
                await heard.next(of("plant/mixer/speed", 2), timeout=15)
                await heard.until(lambda of: len(of.latest()) == 4)
                await live.next(lambda token: token.kind == "PUT")
    finally:
        serves.cancel()
        await asyncio.wait([serves], timeout=5)


async def test_liveliness_shows_gateway_and_devices() -> None:
    plant = mixer()
    async with together(plant) as (northbound, client):
        live = await client.liveliness("plant/**")
        northbound.set_online("mixer", True)
        await live.next(lambda token: (token.key, token.kind) == ("plant/mixer", "PUT"))
        await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
        await client.until_alive("plant/*", ["plant/mixer"])
        northbound.set_online("mixer", False)
        await live.next(lambda token: (token.key, token.kind) == ("plant/mixer", "DELETE"))
        await client.until_alive("plant/*", [])


async def gateway_process(endpoint: str, fails: str = "") -> asyncio.subprocess.Process:
    """This file run as a gateway of its own, already serving."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.northbound.test_northbound",
        endpoint,
        fails,
        cwd=Path(__file__).parents[2],
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    async with asyncio.timeout(10):
        while b"serving" not in await process.stdout.readline():
            pass
    return process


async def test_a_killed_gateway_is_seen_to_be_gone_within_its_lease() -> None:
    endpoint = free_endpoint()
    async with (
        ZenohPeer("router", listen=[endpoint]),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        live = await client.liveliness("plant/@gateway/*")
        process = await gateway_process(endpoint)
        await live.next(lambda token: token.kind == "PUT")
        process.kill()
        await live.next(lambda token: token.kind == "DELETE", timeout=3.0)
        await process.communicate()


@pytest.mark.parametrize("fails", ["loop", "interrupt"])
async def test_the_process_ends_by_itself_with_everything_closed(fails: str) -> None:
    endpoint = free_endpoint()
    async with ZenohPeer("router", listen=[endpoint]):
        process = await gateway_process(endpoint, fails)
        async with asyncio.timeout(4):
            _, errors = await process.communicate()
        assert process.returncode == 1
        assert (b"the loop went wrong" in errors) == (fails == "loop")


async def test_a_frozen_subscriber_does_not_hold_the_loop() -> None:
    plant = PlainPlant(PlainDevice("big", tuple(tag("big", f"t{n}") for n in range(2000))))
    async with together(plant) as (northbound, client):
        await client.subscribe("plant/**")
        worst = 0.0
        stopped = Stopped(client.pid)
        with stopped:
            for value in range(30):
                before = time.perf_counter()
                northbound.publish([plant.now(key, value) for key in plant.samples])
                await asyncio.sleep(0.02)
                worst = max(worst, time.perf_counter() - before)
        assert worst < 0.5  # one put to a frozen peer takes up to 50 ms, 2000 of them would show


class Stopped:
    """A process held still by SIGSTOP."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def __enter__(self) -> None:
        os.kill(self._pid, signal.SIGSTOP)

    def __exit__(self, *_error: object) -> None:
        os.kill(self._pid, signal.SIGCONT)


# -- settings ----------------------------------------------------------------------------------


def test_the_users_zenoh_file_lies_under_the_settings(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        """{
          mode: "client",  // comments are allowed
          connect: {endpoints: ["tcp/10.0.0.1:7447"]},
          listen: {endpoints: ["tcp/127.0.0.1:7000"]},
          transport: {link: {tx: {lease: 5000}}},
        }"""
    )
    config = configure(ZenohConfig(listen=("tcp/127.0.0.1:7447",), config_file=file))
    seen = {
        path: json.loads(config.get_json(path))
        for path in (
            "mode",
            "connect/endpoints",
            "listen/endpoints",
            "transport/link/tx/lease",
            "scouting/multicast/enabled",
        )
    }
    assert seen == {
        "mode": "peer",
        "connect/endpoints": ["tcp/10.0.0.1:7447"],
        "listen/endpoints": ["tcp/127.0.0.1:7447"],
        "transport/link/tx/lease": 5000,
        "scouting/multicast/enabled": False,
    }


def test_nothing_listens_unless_it_is_said_where() -> None:
    assert json.loads(configure(ZenohConfig()).get_json("listen/endpoints")) == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"listen": ("127.0.0.1:7447",)}, "zenoh listen '127.0.0.1:7447'"),
        ({"connect": ("tcp/router",)}, "write it as tcp/host:port"),
        ({"connect": ("tcp/router:99999",)}, "write it as tcp/host:port"),
        ({"connect": ("serial/x:1",)}, "serial is none of tcp"),
        ({"mode": ZenohMode.CLIENT}, "which router"),
        ({"prefix": "plant/**"}, "the prefix 'plant/\\*\\*'"),
        ({"config_file": Path("/nowhere/zenoh.json5")}, "No such file"),
    ],
)
def test_a_mistake_in_the_settings_is_one_sentence(settings: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Northbound(ZenohConfig(**settings), "demo", mixer_outside())


@pytest.mark.parametrize("text", ["{mode: ", "{nonsense: 1}", '{mode: "pear"}'])
def test_a_zenoh_file_that_is_none_is_a_configuration_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"config_file .*zenoh\.json5"):
        configure(ZenohConfig(config_file=file))


def mixer_outside() -> Any:
    return None  # never asked: the settings are looked at first


async def test_a_port_in_use_is_one_sentence_and_ends_the_run() -> None:
    endpoint = free_endpoint()
    async with serving(mixer(), ZenohConfig(listen=(endpoint,))):
        with pytest.raises(GatewayError, match=r"Zenoh cannot be opened: .*"):
            await Northbound(ZenohConfig(listen=(endpoint,)), "second", mixer()).run()


async def test_an_inbox_that_is_full_refuses_and_loses_nothing_it_took() -> None:
    taken: list[int] = []
    refused: list[int] = []
    inbox: Inbox[int] = Inbox(taken.append, refused.append)
    await asyncio.to_thread(lambda: [inbox(n) for n in range(LIMIT)])
    for n in range(LIMIT, LIMIT + 2000):
        inbox(n)
    await until(lambda: len(taken) + len(refused) == LIMIT + 2000)
    assert taken == sorted(taken)
    assert len(refused) >= 2000 - LIMIT


# -- a gateway in a process of its own ---------------------------------------------------------


async def serve(endpoint: str, fails: str) -> None:
    async with serving(mixer(), ZenohConfig(connect=(endpoint,))):
        print("serving", flush=True)
        if fails == "loop":
            await asyncio.sleep(0.2)
            raise RuntimeError("the loop went wrong")
        if fails == "interrupt":
            asyncio.get_running_loop().call_later(0.2, os.kill, os.getpid(), signal.SIGINT)
        await asyncio.Event().wait()


if __name__ == "__main__":
    try:
        asyncio.run(serve(sys.argv[1], sys.argv[2]))
    except KeyboardInterrupt:
        sys.exit(1)
