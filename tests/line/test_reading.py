"""`verify_reads`: a value is believed when two readings in a row say the same."""

import asyncio

from gateway.engine.health import State
from gateway.tags import Quality, Reason
from tests.sim.plant import device, plant, running, words
from tests.sim.virtual import on_virtual_time


@on_virtual_time
async def test_two_readings_that_agree_are_believed_and_both_were_sent() -> None:
    mixer = device(words(100, 2), verify_reads=2)
    hall = plant([mixer])
    async with running(hall):
        await asyncio.sleep(10)
        samples = [told for _, told in hall.told if told.tag is mixer.tags[0]]
        good = sum(told.quality is Quality.GOOD for told in samples)
        reads = sum(data[3:5] == b"51" and b"1CC804" in data for _, data in hall.bench.sent)
        assert good >= 9
        assert reads == 2 * good


@on_virtual_time
async def test_a_value_that_is_another_each_time_is_never_believed() -> None:
    mixer = device(words(100, 1), verify_reads=2)
    hall = plant([mixer])
    hall.stations[0].memory.animate("D", 100, lambda now: int(now * 1000) & 0xFFFF)
    async with running(hall):
        await asyncio.sleep(10)
        assert hall.now[mixer.tags[0]].quality is Quality.BAD
        assert not hall.reads(mixer)
        assert "differ" in hall.now[mixer.tags[0]].detail
        assert hall.now[mixer.tags[0]].reason is Reason.GARBLED


@on_virtual_time
async def test_a_device_is_not_taken_for_silent_because_one_of_its_values_moves() -> None:
    mixer = device([*words(100, 1), *words(900, 1)], verify_reads=2)
    hall = plant([mixer])
    hall.stations[0].memory.animate("D", 100, lambda now: int(now * 1000) & 0xFFFF)
    async with running(hall):
        await asyncio.sleep(20)
        moving, still = mixer.tags
        assert hall.now[moving].quality is Quality.BAD
        assert mixer.state is State.ONLINE
        samples = [told for _, told in hall.told if told.tag is still]
        assert [told.quality for told in samples[1:]] == [Quality.GOOD] * (len(samples) - 1)
        assert len(samples) >= 19
