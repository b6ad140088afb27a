"""A device server that closes an idle connection: the port is opened again at once, each time."""

import asyncio

from gateway.protocols.modbus import ModbusRtu
from tests.line.slaves import plant, registers, slave
from tests.sim.plant import running
from tests.sim.virtual import now, on_virtual_time

IDLE = 3.0  # seconds after which the server closes


@on_virtual_time
async def test_a_session_on_which_a_station_replied_resets_the_pause() -> None:
    driver = ModbusRtu(station=1)
    dev = slave(driver, registers(driver, 2, every=5.0))
    line = plant([dev])
    bench, good, closed = line.bench, 0, list[float]()
    async with running(line):
        await asyncio.sleep(5)
        for _ in range(6000):
            await asyncio.sleep(0.1)
            good += line.good(dev)
            if bench.inner is not None and now() - bench.sent[-1][0] > IDLE:
                closed.append(now())
                bench.vanish("closed by the server")
                bench.come_back()
        await asyncio.sleep(20)
        pauses = [min(at for at in bench.opened if at > end) - end for end in closed]
        assert len(pauses) > 80
        assert max(pauses) < 0.5
        assert good > 0.85 * 6000


@on_virtual_time
async def test_without_a_reply_the_pause_grows() -> None:
    driver = ModbusRtu(station=1)
    dev = slave(driver, registers(driver, 2, every=5.0))
    line = plant([dev])
    line.stations[0].mute = True
    bench = line.bench
    async with running(line):
        for _ in range(1200):
            await asyncio.sleep(0.1)
            if bench.inner is not None:
                bench.vanish("closed by the server")
                bench.come_back()
        assert bench.opened[-1] - bench.opened[-2] > 7.0
