"""Publishing: every value in order, the newest never lost, blocks and events."""

import asyncio
import itertools
import json
import threading
import time
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import zenoh

from gateway.contract import payload
from gateway.contract.keys import Keys
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing import handover
from gateway.northbound.publishing.publisher import EVENTS_LIMIT, Publisher
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.tags import Reason, bad, good
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder, Samples
from gateway.tags.shaping import PLAIN, Bounds, Shaping
from tests.e2e.processes import held, slowed
from tests.northbound.plant import (
    PlainDevice,
    PlainPlant,
    gateway_and_client,
    has_value,
    mixer,
    tag,
)
from tests.sim.plant import make_tag
from tests.zenoh_peer import TIMEOUT, Received

KEYS = Keys("plant", "demo")


async def test_a_published_value_arrives_as_the_contract_says() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (northbound, client):
        received = await client.subscribe("plant/**")
        sample = plant.now("mixer/speed", 12)
        northbound.publish([sample])
        arrived = await received.next(has_value("plant/mixer/speed", 12))
        assert arrived.encoding == "application/json"
        assert set(arrived.json) == {"value", "quality", "time"}
        # A subscriber of values receives no key with @.
        assert not any("@" in sample.key for sample in received.samples)


async def test_values_are_put_in_the_order_of_their_time_stamps() -> None:
    plant = mixer()
    async with gateway_and_client(plant) as (northbound, client):
        received = await client.subscribe("plant/**")
        for value in range(300):
            northbound.publish([plant.now("mixer/speed", value), plant.now("mixer/recipe", value)])
            if value % 7 == 0:
                await asyncio.sleep(0)
        await received.next(has_value("plant/mixer/recipe", 299))
        stamps = [sample.time for sample in received.samples if sample.time is not None]
        assert len(stamps) == len(received.samples)
        assert stamps == sorted(stamps)
        counters = northbound.counters()
        # Only superseded values are missing. Beside the 600: the first publication.
        assert counters["superseded"] + len(received.samples) in range(600, 605)


def a_publisher() -> Publisher:
    return Publisher(SlowPuts(1.0), TagIndex(KEYS, (), lambda _key: None))


class StuckSession:
    """The part of a session that the publisher uses; every put blocks until `go` is set."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.hangs = threading.Event()
        self.puts: list[tuple[int, str, Any]] = []
        self.documents: list[bytes] = []
        self.priorities: list[zenoh.Priority] = []
        self._clock = itertools.count()

    def new_timestamp(self) -> int:
        return next(self._clock)

    def put(
        self, key: str, data: bytes, *, timestamp: int, priority: zenoh.Priority, **_how: object
    ) -> None:
        self.hangs.set()
        assert self.go.wait(TIMEOUT)
        self.puts.append((timestamp, key, json.loads(data)["value"]))
        self.documents.append(data)
        self.priorities.append(priority)


async def test_while_a_put_blocks_the_newest_value_of_each_tag_is_kept_in_order() -> None:
    plant = mixer()
    session: Any = StuckSession()
    publisher = a_publisher()
    publisher.start(session)
    publisher.values([plant.now("mixer/speed", 0)])
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    publisher.values([plant.now("mixer/speed", 1), plant.now("mixer/recipe", 10)])
    publisher.events([plant.now("oven/temperature", value) for value in (100, 101)])
    for value in range(2, 20_000):
        publisher.values([plant.now("mixer/speed", value)])
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    speed, recipe, oven = "plant/mixer/speed", "plant/mixer/recipe", "plant/oven/temperature"
    assert [(key, value) for _, key, value in session.puts] == [
        (speed, 0),
        (recipe, 10),
        (oven, 100),
        (oven, 101),
        (speed, 19_999),
    ]
    assert session.puts == sorted(session.puts)  # by their stamps
    assert publisher.counts()["superseded"] == 19_998
    assert publisher.counts()["published"] == 5


class Block:
    """A block of words in a mirror, read again and again."""

    def __init__(self, shaping: Shaping = PLAIN) -> None:
        made = (make_tag(f"D{n}", device="mixer", name=f"t{n}", type="uint16") for n in range(3))
        self.tags = [replace(tag, shaping=shaping) for tag in made]
        self._decoder = Decoder(self.tags, range(3))
        self._mirror = Mirror(self.tags, 0)
        self._scan = self._decoder.first((0, 0, 0), 1)
        self._mirror.update(self._scan)

    def read(self, *words: int) -> Samples:
        self._scan = self._decoder.after(self._scan, words, self._scan.time + 1)
        samples = self._mirror.update(self._scan)
        assert isinstance(samples, Samples)
        return samples


async def test_of_scans_that_wait_the_newest_value_of_each_tag_is_put_in_order() -> None:
    block, session = Block(), StuckSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values(block.read(1, 1, 1))
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)  # within that scan
    publisher.values(block.read(2, 2, 2))
    publisher.values(block.read(3, 2, 2))
    publisher.values([bad(block.tags[1], Reason.OVERDUE, 9)])
    for word in range(4, 1000):
        publisher.values(block.read(word, 2, 2))
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert [(key.rpartition("/")[2], value) for _, key, value in session.puts] == [
        ("t0", 1),
        ("t1", 1),
        ("t2", 1),
        ("t2", 2),
        ("t1", None),
        ("t0", 999),
    ]
    assert session.puts == sorted(session.puts)  # by their stamps
    assert publisher.counts()["superseded"] == 998
    assert publisher.superseded["mixer/t0"] == 997
    assert publisher.counts()["published"] == 6


async def test_an_alarm_goes_before_the_rest_of_a_scan() -> None:
    block, session = Block(), StuckSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values(block.read(1, 1, 1))
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    publisher.document(KEYS.writes, b'{"value": 7}')
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert [value for *_, value in session.puts] == [1, 7, 1, 1]


@pytest.mark.parametrize(
    "shaping",
    [Shaping(), Shaping(range=Bounds(0, 9)), Shaping(clamp=Bounds(0, 9)), Shaping(decimals=1)],
)
async def test_a_scan_has_the_documents_of_its_samples(shaping: Shaping) -> None:
    block, session = Block(shaping), StuckSession()
    session.go.set()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    samples = block.read(1, 12, 3)
    publisher.values(samples)
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert session.documents == [payload.value(sample) for sample in samples]


async def test_the_loop_waits_until_many_values_are_put(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handover, "_PATIENCE", TIMEOUT)
    monkeypatch.setattr(handover, "SHORTEST", TIMEOUT)
    monkeypatch.setattr(handover, "LONGEST", TIMEOUT)
    session = StuckSession()
    session.go.set()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values([good(make_tag(f"D{n}", type="uint16"), 1, 0) for n in range(200)])
    await asyncio.sleep(0)
    assert publisher.counts()["published"] == 200
    await asyncio.to_thread(publisher.stop, TIMEOUT)


async def test_between_two_slices_of_the_thread_the_loop_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(handover, "_PATIENCE", TIMEOUT)
    monkeypatch.setattr(handover, "SHORTEST", 0.0)
    monkeypatch.setattr(handover, "LONGEST", 0.0)
    session = StuckSession()
    session.go.set()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values([good(make_tag(f"D{n}", type="uint16"), 1, 0) for n in range(500)])
    turns = 0
    while publisher.counts()["published"] < 500:
        await asyncio.sleep(0)
        turns += 1
    assert turns > 10
    await asyncio.to_thread(publisher.stop, TIMEOUT)


async def test_the_loop_waits_once_for_a_link_that_is_stuck(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(handover, "_PATIENCE", 0.2)
    session = StuckSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    many = [make_tag(f"D{n}", type="uint16") for n in range(200)]
    begun = time.monotonic()
    for count in range(1000):
        publisher.values([good(tag, count, 0) for tag in many])
        await asyncio.sleep(0)
    assert time.monotonic() - begun < 100.0  # with a wait each time it would be 200 s
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)


async def test_outcomes_and_alarms_go_before_values_and_documents_that_wait() -> None:
    plant = mixer()
    session = StuckSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values([plant.now("mixer/speed", 0)])
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    publisher.values([plant.now("mixer/recipe", 1)])
    publisher.document(KEYS.status("zenoh"), b'{"value": 2}')
    publisher.document(KEYS.writes, b'{"value": 3}')
    publisher.document(KEYS.writes, b'{"value": 4}')
    for value in (5, 6):  # the latest of each key
        publisher.latest(KEYS.status("alarms/mixer"), f'{{"value": {value}}}'.encode)
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert [value for *_, value in session.puts] == [0, 3, 4, 6, 1, 2]
    urgent, low = zenoh.Priority.INTERACTIVE_HIGH, zenoh.Priority.DATA_LOW
    assert session.priorities == [low, urgent, urgent, urgent, low, low]
    assert publisher.counts()["published"] == 6


class HeldSession(StuckSession):
    """The put of the value 1 waits for `then`."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.then = threading.Event(), threading.Event()

    def put(self, key: str, data: bytes, **how: Any) -> None:
        if json.loads(data)["value"] == 1:
            self.begun.set()
            assert self.then.wait(TIMEOUT)
        super().put(key, data, **how)


async def test_outcomes_that_come_while_others_are_put_go_after_them() -> None:
    """They have one key: a reader that goes by the time stamps would lose those put too late."""
    session = HeldSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values([mixer().now("mixer/recipe", 0)])
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    publisher.values([mixer().now("mixer/speed", 9)])

    def outcomes(*values: int) -> None:
        for value in values:
            publisher.document(KEYS.writes, f'{{"value": {value}}}'.encode())

    outcomes(1, 2, 3)
    session.go.set()
    await asyncio.to_thread(session.begun.wait, TIMEOUT)
    outcomes(4, 5)
    session.then.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert [value for *_, value in session.puts] == [0, 1, 2, 3, 4, 5, 9]


async def test_outcomes_beyond_the_limit_are_dropped_and_counted() -> None:
    session = StuckSession()
    publisher = a_publisher()
    publisher.start(session)  # type: ignore[arg-type]
    publisher.values([mixer().now("mixer/recipe", 0)])
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    for value in range(EVENTS_LIMIT + 5):
        publisher.document(KEYS.writes, f'{{"value": {value}}}'.encode())
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert publisher.counts()["dropped"] == 5
    assert [value for *_, value in session.puts] == [0, *range(EVENTS_LIMIT)]


async def test_events_beyond_the_limit_are_dropped_and_counted() -> None:
    plant = mixer()
    session: Any = StuckSession()
    publisher = a_publisher()
    publisher.events([plant.now("mixer/speed", 0)])  # no session yet
    publisher.start(session)
    publisher.values([plant.now("mixer/recipe", 0)])
    await asyncio.to_thread(session.hangs.wait, TIMEOUT)
    publisher.events(plant.now("mixer/speed", value) for value in range(EVENTS_LIMIT + 5))
    session.go.set()
    await asyncio.to_thread(publisher.stop, TIMEOUT)
    assert publisher.counts()["dropped"] == 6
    assert [value for *_, value in session.puts] == [0, *range(EVENTS_LIMIT)]


async def test_events_all_arrive_in_order() -> None:
    plant = PlainPlant(PlainDevice("mixer", (tag("mixer", "speed", event=True),)))
    async with gateway_and_client(plant) as (northbound, client):
        received = await client.subscribe("plant/mixer/speed")
        northbound.publish([plant.now("mixer/speed", value) for value in range(500)])
        await received.next(has_value("plant/mixer/speed", 499))
        values = [sample.json["value"] for sample in received.samples]
        assert [value for value in values if value is not None] == list(range(500))


async def test_a_scan_of_a_device_with_blocks_is_one_put() -> None:
    plant = mixer(blocks=True)
    async with gateway_and_client(plant) as (northbound, client):
        received = await client.subscribe("plant/*/@block")
        northbound.publish(
            [
                plant.now("mixer/speed", 1),
                plant.now("mixer/recipe", 2),
                plant.now("oven/temperature", 3),
            ]
        )
        block = await received.next(lambda sample: True)
        assert block.key == "plant/mixer/@block"
        assert {name: entry["value"] for name, entry in block.json.items()} == {
            "speed": 1,
            "recipe": 2,
        }
        [reply] = await client.get("plant/*/@block")
        assert set(reply.json) == {"speed", "recipe", "alarms/door"}


async def test_blocks_are_counted_so_that_a_missing_one_is_seen() -> None:
    plant = mixer(blocks=True)
    epochs = []
    for _ in range(2):
        async with gateway_and_client(plant) as (northbound, client):
            received = await client.subscribe("plant/mixer/@block")
            for value in (1, 2, 3):
                northbound.publish([plant.now("mixer/speed", value)])
                await received.next(partial(holds, value))
            places = [json.loads(block.attachment) for block in received.samples]
            first = places[0]["seq"]
            assert [place["seq"] for place in places] == [*range(first, first + len(places))]
            [epoch] = {place["epoch"] for place in places}
            epochs.append(epoch)
    assert epochs[0] != epochs[1]


def holds(value: int, block: Received) -> bool:
    return bool(block.json.get("speed", {}).get("value") == value)


async def test_with_blocks_only_no_single_value_is_put() -> None:
    plant = mixer(blocks="only")
    async with gateway_and_client(plant) as (northbound, client):
        received = await client.subscribe("plant/**")
        block = await client.subscribe("plant/mixer/@block")
        northbound.publish([plant.now("mixer/speed", 1), plant.now("oven/temperature", 3)])
        scan = await block.next(lambda sample: sample.json["speed"]["value"] == 1)
        assert set(scan.json) >= {"speed"}
        await received.next(has_value("plant/oven/temperature", 3))
        assert not [sample.key for sample in received.samples if "mixer" in sample.key]
        # A query returns them, but not that of a subscriber, which would then wait for new ones.
        [reply] = await client.get("plant/mixer/speed")
        assert reply.json["value"] == 1
        late = await client.subscribe("plant/**", advanced=True)
        await late.next(has_value("plant/oven/temperature", 3))
        assert not [sample.key for sample in late.samples if "mixer" in sample.key]


async def test_a_frozen_subscriber_does_not_block_the_event_loop() -> None:
    plant = PlainPlant(PlainDevice("big", tuple(tag("big", f"t{n}") for n in range(2000))))
    async with gateway_and_client(plant) as (northbound, client):
        await client.subscribe("plant/**")
        worst = 0.0
        with held(client.pid):
            for value in range(30):
                before = time.perf_counter()
                northbound.publish([plant.now(key, value) for key in plant.samples])
                await asyncio.sleep(0.02)
                worst = max(worst, time.perf_counter() - before)
        assert worst < slowed(0.5)  # one put to a frozen peer takes up to 50 ms, 2000 of them 100 s
