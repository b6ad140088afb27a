"""Queries of values, descriptions and status."""

import asyncio

from gateway.tags import Reason, Sample, Tag, bad
from tests.no_parts import STATUS
from tests.northbound.plant import (
    PlainDevice,
    PlainPlant,
    gateway_and_client,
    has_value,
    mixer,
    tag,
)

NONE = "NONE"  # Zenoh's consolidation that streams


async def test_ten_thousand_current_values_by_one_wildcard_get() -> None:
    devices = [
        PlainDevice(f"d{d}", tuple(tag(f"d{d}", f"t{t}") for t in range(500))) for d in range(20)
    ]
    plant = PlainPlant(*devices)
    for number, key in enumerate(plant.samples):
        plant.now(key, number)
    async with gateway_and_client(plant) as (_, client):
        for selector, count in (
            ("plant/**", 10_000),
            ("**", 10_000),
            ("plant/d7/*", 500),
            ("plant/*/t3", 20),
            ("plant/d1$*/t3", 11),
            ("plant/d7/t3", 1),
            ("plant/unknown/t3", 0),
        ):
            replies = await client.get(selector, consolidation=NONE)
            assert len({reply.key for reply in replies}) == len(replies) == count, selector
            for reply in replies:
                assert reply.key is not None
                assert reply.json["value"] == plant.samples[reply.key[6:]].value
        stamps = [reply.time for reply in await client.get("plant/d7/*", consolidation=NONE)]
        assert len(set(stamps)) == 500


async def test_a_late_advanced_subscriber_gets_every_last_value_and_then_new_ones() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (northbound, client):
        northbound.publish([plant.now("mixer/speed", 1), plant.now("oven/temperature", 200)])
        received = await client.subscribe("plant/**", advanced=True)
        await received.until(lambda of: len(of.latest()) == 4)
        assert received.latest()["plant/oven/temperature"].json["value"] == 200
        assert received.latest()["plant/mixer/recipe"].json["reason"] == "starting"
        for value in range(2, 50):
            northbound.publish([plant.now("mixer/speed", value), plant.now("mixer/recipe", value)])
            await asyncio.sleep(0.001)
        await received.next(has_value("plant/mixer/speed", 49))
        await received.next(has_value("plant/mixer/recipe", 49))


async def test_every_tag_is_found_by_its_meta_key() -> None:
    async with gateway_and_client(mixer()) as (_, client):
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
    async with gateway_and_client(mixer()) as (_, client):
        keys = {reply.key for reply in await client.get("plant/@gateway/*/**")}
        own = "plant/@gateway/demo"
        claim = next(key for key in keys if key is not None and "/claim/" in key)
        names = ("status", "loads/hall-1", "zenoh", "outcomes", "report")
        assert keys == {f"{own}/{name}" for name in names} | {claim}
        [reply] = await client.get(f"{own}/loads/*")
        assert reply.json == {"load": 0.5}
        received = await client.subscribe("plant/@gateway/*/status")
        status = (await received.next(lambda _: True)).json
        assert status == {
            **STATUS,
            "refused_devices": {},
            "refused_claims": [],
            "answered_elsewhere": None,
        }
        [claimed] = await client.get(claim)
        assert claimed.json["devices"] == ["mixer", "oven"]


async def test_max_age_reads_the_device_unless_the_sample_is_younger() -> None:
    plant = mixer()
    plant.now("mixer/speed", 12)
    async with gateway_and_client(plant) as (_, client):
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
        assert await client.get("plant/unknown/speed?max_age=soon") == []


async def test_a_tag_that_cannot_be_read_does_not_suppress_other_values() -> None:
    plant = mixer()
    plant.unread = {"mixer/recipe"}
    async with gateway_and_client(plant) as (_, client):
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


async def test_a_tag_that_becomes_too_old_while_another_is_read_is_read_too() -> None:
    class Slow(PlainPlant):
        """Reading the speed takes so long that all other samples are too old afterwards."""

        def is_fresh(self, tag: Tag, max_age: float) -> bool:
            return "mixer/speed" not in self.read and tag.name != "speed"

        async def fresh(self, tag: Tag, max_age: float) -> Sample:
            if tag.name == "speed":
                await asyncio.sleep(0)
            return await super().fresh(tag, max_age)

    plant = Slow(*mixer().devices())
    async with gateway_and_client(plant) as (_, client):
        replies = await client.get("plant/mixer/*?max_age=1s")
        assert {reply.json["value"] for reply in replies} == {4711}
        assert plant.read == ["mixer/speed", "mixer/recipe"]  # each once


async def test_a_tag_that_turned_bad_after_its_read_is_answered_bad() -> None:
    class Failing(PlainPlant):
        async def fresh(self, tag: Tag, max_age: float) -> Sample:
            read = await super().fresh(tag, max_age)
            an_hour_back = read.time - 3600 * 10**9
            self.samples[tag.key] = bad(tag, Reason.NO_REPLY, an_hour_back)
            return read

    async with gateway_and_client(Failing(*mixer().devices())) as (_, client):
        [reply] = await client.get("plant/mixer/speed?max_age=0s")
        assert (reply.json["value"], reply.json["reason"]) == (None, "no-reply")


async def test_a_query_of_the_past_is_refused_without_history() -> None:
    async with gateway_and_client(mixer()) as (_, client):
        for selector in ("plant/mixer/speed?_time=[now(-1h)..]", "plant/**?_time=[..]"):
            [reply] = await client.get(selector)
            assert not reply.ok
            assert reply.json["error"] == "no-history"
        assert await client.get("plant/unknown/speed?_time=[..]") == []
