"""`verify_reads`: a sample is good when two reads in a row are equal."""

import asyncio

from gateway.engine.device.health import State
from gateway.tags import Quality, Reason
from tests.sim.plant import device, plant, running, words
from tests.sim.virtual import on_virtual_time


@on_virtual_time
async def test_two_equal_reads_make_one_good_sample() -> None:
    mixer = device(words(100, 2), verify_reads=2)
    hall = plant([mixer])
    async with running(hall):
        await asyncio.sleep(10)
        samples = [sample for _, sample in hall.reported if sample.tag is mixer.tags[0]]
        good = sum(sample.quality is Quality.GOOD for sample in samples)
        reads = sum(data[3:5] == b"51" and b"1CC804" in data for _, data in hall.bench.sent)
        assert good >= 9
        assert reads - 2 * good in (0, 1)  # a second read may not have ended


@on_virtual_time
async def test_a_value_that_differs_at_each_read_stays_bad() -> None:
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
async def test_a_device_with_one_changing_value_stays_online() -> None:
    mixer = device([*words(100, 1), *words(900, 1)], verify_reads=2)
    hall = plant([mixer])
    hall.stations[0].memory.animate("D", 100, lambda now: int(now * 1000) & 0xFFFF)
    async with running(hall):
        await asyncio.sleep(20)
        moving, still = mixer.tags
        assert hall.now[moving].quality is Quality.BAD
        assert mixer.state is State.ONLINE
        samples = [sample for _, sample in hall.reported if sample.tag is still]
        assert [sample.quality for sample in samples[1:]] == [Quality.GOOD] * (len(samples) - 1)
        assert len(samples) >= 19
