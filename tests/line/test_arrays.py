"""Arrays on a simulated wire with faults: never of two replies, and refused as a whole."""

import asyncio

from gateway.tags import Quality, Reason
from tests.sim.plant import clockwork, device, make_tag, plant, running, words
from tests.sim.virtual import on_virtual_time


@on_virtual_time
async def test_all_elements_are_of_one_moment_whatever_the_wire_does() -> None:
    numbers = range(100, 150)
    steps = make_tag("D100", type="uint16[50]", name="steps", every=0.2)
    dev = device([steps, make_tag("D120", type="uint16", every=0.2), *words(150, 5)])
    line = plant([dev])
    station = line.stations[0]
    station.lose, station.cut, line.bench.noise = 0.03, 0.03, 0.0003
    station.late = lambda chance: 0.4 if chance.random() < 0.05 else 0.0
    clockwork(station.memory, range(100, 155))
    async with running(line):
        await asyncio.sleep(60)
    values = [sample.value for _, sample in line.reported if sample.tag is steps]
    good = [value for value in values if isinstance(value, tuple)]
    assert len(good) > 150
    assert station.lost > 3
    assert line.bench.damaged > 3
    for value in good:
        moments = {(int(word) - 1777 * n) % 65536 for word, n in zip(value, numbers, strict=True)}
        assert len(moments) == 1


@on_virtual_time
async def test_one_refused_address_makes_its_array_bad_and_no_neighbour() -> None:
    steps = make_tag("D100", type="uint16[50]", name="steps")
    dev = device([steps, *words(150, 10)])
    line = plant([dev])
    line.stations[0].inner.memory.holes = {("D", 110)}
    async with running(line):
        await asyncio.sleep(3)
        assert (line.now[steps].value, line.reason(steps)) == (None, Reason.REFUSED)
        assert all(line.now[tag].quality is Quality.GOOD for tag in dev.tags[1:])
        assert [block.span.size for block in dev.blocks] == [50, 10]
