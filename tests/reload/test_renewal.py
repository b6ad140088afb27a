"""A changed file is taken over device by device; all other devices go on."""

import asyncio
import gc
import random
import weakref
from collections import Counter
from itertools import pairwise
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Poll
from gateway.errors import Busy, GatewayError
from gateway.line.line import Line
from gateway.parts.alarms.part import AlarmPart
from gateway.tags import Quality, Reason, Tag
from tests.parts.made import find
from tests.reload.plant import Data, Plant, file, running, vigor
from tests.sim.virtual import on_virtual_time
from tests.writing import write

MIXER = {"mixer": vigor(1), "oven": vigor(2)}


def device(data: Data, name: str) -> Data:
    found: Data
    (found,) = (one["devices"][name] for one in data["lines"].values() if name in one["devices"])
    return found


@on_virtual_time
async def test_an_interval_changes_and_no_value_turns_bad() -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level", "oven/level")
        before, states = plant.sample("mixer/level"), len(plant.online)
        polls = plant.polls("hall")
        await plant.reload(lambda data: device(data, "mixer").update(defaults={"every": "200ms"}))
        after = plant.sample("mixer/level")
        assert (after.value, after.quality, after.time) == (before.value, Quality.GOOD, before.time)
        assert after.tag is not before.tag
        assert plant.sample("mixer/level").tag.every == 0.2
        await asyncio.sleep(10)
        assert all(sample.quality is Quality.GOOD for sample in plant.published)
        assert plant.online[states:] == []
        assert 49 <= sum(name == "mixer" for name, _ in polls) <= 102  # two blocks or one
        assert plant.gateway.lines[0].engine.record.opened == 1


@on_virtual_time
async def test_the_reload_of_one_of_64_lines_costs_the_others_no_poll() -> None:
    lines = {f"line-{n}": {f"plc-{n}": vigor(1)} for n in range(64)}
    async with running(file(**lines)) as plant:
        await plant.until_good(*(f"plc-{n}/level" for n in range(64)))
        polls = [plant.polls(f"line-{n}") for n in range(64)]
        devices = plant.gateway.enabled_devices
        await asyncio.sleep(3)
        await plant.reload(lambda data: device(data, "plc-7").update(defaults={"every": "300ms"}))
        await asyncio.sleep(3)
        changed = [n for n, one in enumerate(plant.gateway.enabled_devices) if one not in devices]
        assert changed == [7]
        for n, found in enumerate(polls):
            begun = [at for _, at in found]
            gaps = [b - a for a, b in pairwise(begun)]
            assert max(gaps) < 1.05, n
            assert plant.gateway.enabled_devices[n].record.overruns == 0
        assert len(polls[7]) > len(polls[8])


@on_virtual_time
async def test_tags_come_and_go_while_their_neighbours_stay() -> None:
    def change(data: Data) -> None:
        tags = device(data, "mixer")["tags"]
        del tags["recipe"]
        tags["more"] = {"address": "D11"}
        tags["level"]["description"] = "of the tank"

    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level", "mixer/recipe")
        recipe = plant.gateway.tag("mixer/recipe")
        assert recipe is not None
        await plant.reload(change)
        assert plant.gateway.tag("mixer/recipe") is None
        last = plant.of("mixer/recipe")[-1]
        assert (last.quality, last.reason) == (Quality.BAD, Reason.DISABLED)
        # A client that asked before the reload finds it disabled too.
        assert plant.gateway.sample(recipe).reason is Reason.DISABLED
        assert plant.of("mixer/more")[0].reason is Reason.STARTING
        assert plant.sample("mixer/level").quality is Quality.GOOD
        await plant.until_good("mixer/more")
        with pytest.raises(Busy, match="the file was reloaded"):
            await write(plant.gateway, recipe, 7)


@pytest.mark.parametrize(
    "change",
    [
        {"tags": {"level": {"address": "D12"}}},
        {"tags": {"level": {"address": "D10", "scale": 0.1}}},
        {"station": 5},
        {"enabled": False},
    ],
    ids=["address", "scale", "station", "enabled"],
)
@on_virtual_time
async def test_a_value_with_another_meaning_begins_again(change: dict[str, Any]) -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level", "oven/level")
        await plant.reload(lambda data: device(data, "mixer").update(change))
        first = plant.of("mixer/level")[0]
        expected = Reason.STARTING if change.get("enabled", True) else Reason.DISABLED
        assert (first.quality, first.reason) == (Quality.BAD, expected)
        assert plant.sample("oven/level").quality is Quality.GOOD
        if change.get("enabled", True):
            await plant.until_good("mixer/level")
        else:
            assert plant.online[-1] == ("mixer", False)
            await plant.reload(lambda data: device(data, "mixer").pop("enabled"))
            await plant.until_good("mixer/level")


@on_virtual_time
async def test_a_silent_device_is_not_good_for_longer_after_a_reload() -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level")
        (line,) = plant.gateway.lines
        await plant.reload(lambda data: device(data, "mixer").update(defaults={"every": "2s"}))
        port: Any = line._open_port  # private: only the simulated wire can lose a station
        port._stations[0].mute = True
        await asyncio.sleep(6)
        assert plant.sample("mixer/level").quality is Quality.BAD
        await plant.reload(lambda data: device(data, "mixer").update(defaults={"every": "1s"}))
        assert plant.sample("mixer/level").quality is Quality.BAD
        port._stations[0].mute = False
        await plant.until_good("mixer/level")


@on_virtual_time
async def test_a_waiting_write_to_a_changed_device_is_refused_and_one_in_flight_ends() -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/recipe", "oven/recipe")
        mixer, oven = plant.gateway.tag("mixer/recipe"), plant.gateway.tag("oven/recipe")
        assert mixer is not None
        assert oven is not None
        writes = [asyncio.create_task(write(plant.gateway, tag, 7)) for tag in (mixer, mixer, oven)]
        await asyncio.sleep(0.004)  # the first is on the wire
        await plant.reload(lambda data: device(data, "mixer").update(station=5))
        first, second, third = await asyncio.gather(*writes, return_exceptions=True)
        assert not isinstance(first, BaseException)
        assert first.acknowledged
        assert isinstance(second, Busy)
        assert str(second) == "the file was reloaded and changed mixer; not sent"
        assert not isinstance(third, BaseException)


@on_virtual_time
async def test_devices_move_and_lines_open_and_close() -> None:
    def move(data: Data) -> None:
        hall, yard = data["lines"]["hall"]["devices"], data["lines"]["yard"]["devices"]
        yard["mixer"] = hall.pop("mixer")

    def speed(data: Data) -> None:
        data["lines"]["yard"]["baudrate"] = 9600

    def close(data: Data) -> None:
        del data["lines"]["hall"]
        data["lines"]["roof"] = {"port": "simulator", "devices": {"fan": vigor(1)}}

    async with running(file(hall=MIXER, yard={"pump": vigor(3)})) as plant:
        await plant.until_good("mixer/level", "oven/level", "pump/level")
        await plant.reload(move)
        assert [s.reason for s in plant.of("mixer/level")] == [Reason.STARTING]
        assert plant.sample("oven/level").quality is Quality.GOOD
        assert plant.sample("pump/level").quality is Quality.GOOD
        await plant.until_good("mixer/level")
        await plant.reload(speed)
        assert plant.sample("pump/level").reason is Reason.STARTING
        await plant.until_good("mixer/level", "pump/level")
        await plant.reload(close)
        await plant.until_good("fan/level")
        assert plant.gateway.tag("oven/level") is None
        status = plant.gateway.status()
        assert {path for path in status if path.startswith(("lines/", "devices/"))} == {
            *("lines/yard", "lines/roof"),
            *("devices/mixer", "devices/pump", "devices/fan"),
        }
        assert not plant.lines.failed.is_set()


@on_virtual_time
async def test_computed_tags_follow_their_inputs() -> None:
    def computed(data: Data, formula: str) -> None:
        device(data, "oven")["tags"]["sum"] = {"computed": formula}

    devices = {"mixer": vigor(1), "oven": vigor(2)}
    data = file(hall=devices, yard={"pump": vigor(3)})
    computed(data, "level + 'mixer/level'")
    async with running(data) as plant:
        await plant.until_good("mixer/level", "oven/level", "oven/sum")
        before = plant.sample("oven/sum").tag
        await plant.reload(lambda data: device(data, "pump").update(defaults={"every": "300ms"}))
        assert plant.sample("oven/sum").tag is before
        # An input goes on as another tag, and the sum with it.
        await plant.reload(lambda data: device(data, "mixer").update(defaults={"every": "300ms"}))
        assert plant.sample("oven/sum").quality is Quality.GOOD
        assert all(sample.quality is Quality.GOOD for sample in plant.published)
        # The input is read from another station.
        await plant.reload(lambda data: device(data, "mixer").update(station=7))
        assert plant.sample("oven/sum").reason is Reason.STARTING
        await plant.until_good("oven/sum")
        values = [plant.sample(key).value for key in ("oven/sum", "oven/level", "mixer/level")]
        assert values[0] == values[1] + values[2]  # type: ignore[operator]  # numbers
        await plant.reload(lambda data: computed(data, "2 * level"))
        assert plant.sample("oven/sum").value == 2 * plant.sample("oven/level").value  # type: ignore[operator]
        await plant.reload(lambda data: device(data, "oven").update(enabled=False))
        assert plant.sample("oven/sum").reason is Reason.DISABLED
        await plant.reload(lambda data: device(data, "oven").pop("enabled"))
        await plant.until_good("oven/sum")
        await plant.reload(lambda data: device(data, "oven")["tags"].pop("sum"))
        assert plant.gateway.tag("oven/sum") is None
        assert plant.of("oven/sum")[-1].reason is Reason.DISABLED


@on_virtual_time
async def test_alarms_follow_their_tags_devices_and_lines() -> None:
    def alarmed(data: Data, high: float) -> None:
        device(data, "mixer")["tags"]["level"]["alarm"] = {"high": high}

    data = file(hall={"mixer": vigor(1), "oven": vigor(2)}, yard={"pump": vigor(3)})
    alarmed(data, -1.0)
    async with running(data) as plant:
        alarms = find(plant.parts, AlarmPart).alarms
        await plant.until_good("mixer/level")
        assert list(alarms.tally.open) == ["mixer/level"]
        await plant.reload(lambda data: device(data, "mixer").update(defaults={"every": "200ms"}))
        assert list(alarms.tally.open) == ["mixer/level"]
        await asyncio.sleep(2)  # the line goes on with the alarm of the tag
        assert plant.sample("mixer/level").quality is Quality.GOOD
        await plant.reload(lambda data: device(data, "mixer").update(station=7))
        assert list(alarms.tally.open) == ["mixer/level"]  # bad quality never clears an alarm
        await plant.reload(lambda data: alarmed(data, 30000.0))
        assert list(alarms.tally.open) == []
        await plant.reload(lambda data: data["lines"].pop("hall"))
        assert set(alarms.entries) == {"pump", "line:yard"}


@on_virtual_time
async def test_a_client_that_waits_for_a_read_gets_its_answer() -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level", "mixer/recipe")
        level, recipe = plant.gateway.tag("mixer/level"), plant.gateway.tag("mixer/recipe")
        assert level is not None
        assert recipe is not None
        reads = [asyncio.create_task(plant.gateway.fresh(tag, 0.0)) for tag in (level, recipe)]
        await asyncio.sleep(0)
        await plant.reload(lambda data: device(data, "mixer")["tags"].pop("recipe"))
        good, gone = await asyncio.gather(*reads, return_exceptions=True)
        assert not isinstance(good, BaseException)
        assert good.quality is Quality.GOOD
        assert isinstance(gone, GatewayError)


REMOVABLE = vigor(9, level={"address": "D20"})


def change_at_random(data: Data, chance: random.Random) -> None:
    """Changes one thing of the file of `MIXER`."""
    devices = data["lines"]["hall"]["devices"]
    mixer = devices["mixer"]
    match chance.randrange(5):
        case 0:
            mixer["defaults"] = {"every": f"{chance.randrange(100, 2000)}ms"}
        case 1:
            mixer["tags"].setdefault("more", {"address": f"D{chance.randrange(11, 90)}"})
        case 2:
            mixer["tags"].pop("more", None)
        case 3:
            devices.setdefault("guest", REMOVABLE)
        case _:
            devices.pop("guest", None)
            data["lines"]["hall"]["baudrate"] = chance.choice((9600, 19200))


async def reload_often(plant: Plant, times: int, chance: random.Random) -> dict[type, int]:
    """Reloads under load. Returns the number of objects of a plant, by class."""
    for _ in range(times):
        await plant.reload(lambda data: change_at_random(data, chance))
        await asyncio.sleep(chance.uniform(0.0, 0.5))
    await asyncio.sleep(5)
    gc.collect()
    found = Counter(map(type, gc.get_objects()))
    return {kind: found[kind] for kind in (Line, Engine, Device, Tag, Poll)}


@on_virtual_time
async def test_many_reloads_leave_nothing() -> None:
    async with running(file(hall=MIXER)) as plant:
        await plant.until_good("mixer/level")
        chance = random.Random(5)
        before = await reload_often(plant, 10, chance)
        after = await reload_often(plant, 10, chance)
        assert all(after[kind] <= before[kind] + 6 for kind in before), (before, after)
        keys = {tag.key for device in plant.gateway.devices() for tag in device.tags}
        mirror = plant.gateway.mirror
        assert {sample.tag.key for sample in mirror.samples()} == keys
        engine = plant.gateway.lines[0].engine
        assert set(engine.schedule._polls) == set(engine.devices)  # private: a leak shows nowhere
        assert {tag.key for tag in mirror._published} <= keys
        await plant.until_good(*keys)


@on_virtual_time
async def test_no_timer_keeps_an_ended_line() -> None:
    async with running(file(hall=MIXER, yard={"press": vigor(1)})) as plant:
        await plant.until_good("mixer/level")
        ended = weakref.ref(plant.gateway.lines[0])
        await plant.reload(lambda data: data["lines"]["hall"].update(baudrate=9600))
        await asyncio.sleep(0.1)  # its time-outs are longer
        gc.collect()
        assert ended() is None
