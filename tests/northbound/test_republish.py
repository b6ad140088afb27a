"""Publishing again: heartbeats of bad values, and all values after a link has returned."""

import asyncio
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from typing import Any

import pytest

from gateway.config import ZenohConfig, ZenohMode
from gateway.contract.keys import Keys
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing.republish import Republisher
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.northbound.session.link_monitor import LinkMonitor
from gateway.tags import Reason, Sample, bad
from tests.northbound.plant import (
    PlainDevice,
    PlainPlant,
    has_value,
    mixer,
    northbound_of,
    nothing,
    serving,
    tag,
)
from tests.sim.virtual import now, on_virtual_time
from tests.zenoh_peer import TIMEOUT, ZenohPeer, free_endpoint


@pytest.mark.parametrize("event", [False, True])
def test_a_bad_value_is_repeated_with_its_heartbeat_and_keeps_its_time(event: bool) -> None:
    @on_virtual_time
    async def repeats() -> None:
        repeated = tag("mixer", "speed", heartbeat=0.5, event=event)
        other = tag("mixer", "level")  # without a heartbeat
        plant, published = PlainPlant(PlainDevice("mixer", (repeated, other))), list[Sample]()
        down = {of.key: bad(of, Reason.NO_REPLY, time.time_ns()) for of in (repeated, other)}
        plant.samples |= down
        task = asyncio.create_task(republisher(plant, published).run())
        await asyncio.sleep(3.5)
        assert published == [down[repeated.key]] * 2
        plant.now(repeated.key, 7)
        await asyncio.sleep(3.0)
        assert len(published) == 2
        task.cancel()

    repeats()


async def test_an_event_is_published_once_but_its_bad_quality_again() -> None:
    code, weight = tag("reader", "code", event=True), tag("reader", "weight")
    plant = PlainPlant(PlainDevice("reader", (code, weight)))
    index = TagIndex(Keys("plant", "demo"), plant.devices(), plant.tag)
    published: list[Sample] = []
    losses = SlowPuts(1.0)
    republisher = Republisher(published.extend, plant, index, LinkMonitor(), losses, 600.0, nothing)
    await republisher.publish_all()  # as at a start
    assert published == [bad(of, Reason.STARTING, plant.sample(of).time) for of in (code, weight)]
    published.clear()
    plant.now("reader/code", 4711)
    heavy = plant.now("reader/weight", 12)
    await republisher.publish_all()
    assert published == [heavy]
    published.clear()
    lost = plant.samples["reader/code"] = bad(code, Reason.LINE_DOWN, time.time_ns())
    await republisher.publish_all()
    assert published == [lost, heavy]


async def test_the_plant_marks_republished_samples_before_they_go_out() -> None:
    plant, published = mixer(), list[Sample]()

    def publish(samples: Sequence[Sample]) -> None:
        published.extend(samples)
        assert plant.republished == published

    index = TagIndex(Keys("plant", "demo"), plant.devices(), plant.tag)
    await Republisher(
        publish, plant, index, LinkMonitor(), SlowPuts(1.0), 600.0, nothing
    ).publish_all()
    assert len(published) == 4


@pytest.mark.parametrize("mode", [ZenohMode.PEER, ZenohMode.CLIENT])
async def test_after_a_router_was_killed_and_returned_everything_is_published_again(
    mode: ZenohMode,
) -> None:
    plant = mixer()
    endpoint = free_endpoint()
    # The gateway starts without its router.
    northbound = northbound_of(plant, ZenohConfig(mode=mode, connect=(endpoint,)))
    serves = asyncio.create_task(northbound.run())
    northbound.publish([plant.now("mixer/speed", 1)])
    try:
        async with (
            ZenohPeer("router", listen=[endpoint]) as router,
            ZenohPeer("client", connect=[endpoint]) as client,
        ):
            received = await client.subscribe("plant/**")
            await received.next(has_value("plant/mixer/speed", 1))
            live = await client.liveliness("plant/@gateway/*")
            await live.next(lambda token: token.kind == "PUT")
            await router.kill()
            received.forget()
            live.forget()
            northbound.publish([plant.now("mixer/speed", 2)])  # no link: it reaches no subscriber
            async with ZenohPeer("router", listen=[endpoint]):
                await received.next(has_value("plant/mixer/speed", 2), timeout=TIMEOUT)
                await received.until(lambda of: len(of.latest()) == 4)
                await live.next(lambda token: token.kind == "PUT")
    finally:
        serves.cancel()
        await asyncio.wait([serves], timeout=TIMEOUT)


async def test_a_client_of_the_process_before_gets_all_values_of_the_next() -> None:
    plant, settings = mixer(), ZenohConfig(listen=(free_endpoint(),))
    async with AsyncExitStack() as peers:
        async with serving(plant, settings) as northbound:
            client = ZenohPeer("client", connect=settings.listen)
            received = await (await peers.enter_async_context(client)).subscribe("plant/**")
            northbound.publish([plant.now("mixer/speed", 1)])
            await received.next(has_value("plant/mixer/speed", 1))
            received.forget()
        plant.now("mixer/speed", 2)
        async with serving(plant, settings):  # it has published all before the client is linked
            await received.next(has_value("plant/mixer/speed", 2))
            await received.until(lambda of: len(of.latest()) == 4)


async def test_no_value_is_put_before_there_is_a_link() -> None:
    async with serving(of_mixer(1000), ZenohConfig(listen=(free_endpoint(),))) as northbound:
        pass  # its end puts all that waits
    assert northbound.counters()["published"] < 100  # documents


def republisher(plant: PlainPlant, published: list[Sample], **how: Any) -> Republisher:
    index = TagIndex(Keys("plant", "demo"), plant.devices(), plant.tag)
    settings = {"links": LinkMonitor(), "losses": SlowPuts(0.05), "refresh": 1e6, **how}
    return Republisher(published.extend, plant, index, parts=nothing, **settings)


def of_mixer(count: int) -> PlainPlant:
    plant = PlainPlant(PlainDevice("mixer", tuple(tag("mixer", f"t{n}") for n in range(count))))
    for n in range(count):
        plant.now(f"mixer/t{n}", n)
    return plant


@on_virtual_time
async def test_values_that_a_full_link_may_have_dropped_are_published_again() -> None:
    plant, published, losses = of_mixer(1000), list[Sample](), SlowPuts(0.05)
    current = list(plant.samples.values())
    losses.sent([f"plant/{sample.tag.key}" for sample in current[:300]], 0.05, now())
    task = asyncio.create_task(republisher(plant, published, losses=losses).run())
    await asyncio.sleep(1.6)
    assert published == current[:300]
    task.cancel()


@on_virtual_time
async def test_a_round_ends_when_the_link_is_full_again() -> None:
    plant, losses = of_mixer(1000), SlowPuts(0.05)
    published: list[Sample] = []

    def publish(samples: Sequence[Sample]) -> None:
        published.extend(samples)
        losses.sent([f"plant/{sample.tag.key}" for sample in samples], 0.05, now())

    index = TagIndex(Keys("plant", "demo"), plant.devices(), plant.tag)
    losses.sent([f"plant/{sample.tag.key}" for sample in plant.samples.values()], 0.05, now())
    again = Republisher(publish, plant, index, LinkMonitor(), losses, 1e6, nothing)
    task = asyncio.create_task(again.run())
    await asyncio.sleep(1.4)
    assert len(published) == 100
    await asyncio.sleep(12.0)
    assert len(set(published[:1000])) == 1000  # each round continues the one before
    task.cancel()


@on_virtual_time
async def test_every_value_is_published_once_in_the_time_of_refresh() -> None:
    plant, published = of_mixer(1000), list[Sample]()
    task = asyncio.create_task(republisher(plant, published, refresh=60.0).run())
    await asyncio.sleep(30.05)
    assert len(published) in range(490, 511)  # evenly
    await asyncio.sleep(30.0)
    assert {sample.tag.name for sample in published} == {f"t{n}" for n in range(1000)}
    assert len(published) < 1020
    task.cancel()


@on_virtual_time
async def test_a_link_that_flaps_publishes_everything_at_growing_pauses() -> None:
    plant, published, links = of_mixer(10), list[Sample](), LinkMonitor()
    task = asyncio.create_task(republisher(plant, published, links=links).run())
    for _ in range(600):  # ten minutes
        links.returned.set()
        await asyncio.sleep(1.0)
    assert len(published) in range(220, 300)  # not 10 times 600
    links.returned.set()
    published.clear()
    await asyncio.sleep(31.0)
    assert len(published) >= 10  # the last return is not forgotten
    await asyncio.sleep(60.0)
    published.clear()
    links.returned.set()
    await asyncio.sleep(0.4)
    assert len(published) == 10  # calm: at once again
    task.cancel()
