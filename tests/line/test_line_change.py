"""A line takes over changed devices between two transactions, and at once while it is closed."""

import asyncio
from typing import Any

from gateway.engine.device.changes import Changes
from tests.reload.plant import file, running, vigor
from tests.sim.virtual import on_virtual_time


@on_virtual_time
async def test_a_change_waits_for_the_end_of_the_transaction() -> None:
    async with running(file(hall={"mixer": vigor(1), "oven": vigor(2)})) as plant:
        await plant.until_good("mixer/level", "oven/level")
        (line,) = plant.gateway.lines
        port: Any = line._open_port  # private: only the simulated wire can lose its stations
        for station in port._stations:
            station.mute = True
        while line.engine.is_idle:
            await asyncio.sleep(0.001)
        idle: list[bool] = []  # the time-out of the poll is followed by the wait for a late reply
        change = asyncio.create_task(
            line.change(Changes(), (), lambda: idle.append(line.engine.is_idle))
        )
        await asyncio.sleep(0)
        assert idle == []
        await change
        assert idle == [True]


@on_virtual_time
async def test_a_closed_line_takes_a_change_over_at_once_or_when_it_ends() -> None:
    async with running(file(hall={"mixer": vigor(1)})) as plant:
        await plant.until_good("mixer/level")
        (line,) = plant.gateway.lines
        while line.engine.is_idle:
            await asyncio.sleep(0.001)
        applied: list[str] = []
        waiting = asyncio.create_task(line.change(Changes(), (), lambda: applied.append("end")))
        await asyncio.sleep(0)
        await plant.lines.end(line)
        await waiting
        await line.change(Changes(), (), lambda: applied.append("closed"))
        assert applied == ["end", "closed"]
