"""A slave that replies to a broadcast, against the standard: that acknowledges no other write."""

import asyncio

import pytest

from gateway.errors import GatewayError
from gateway.protocols.checksums import crc16
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import WriteResult, WriteRule
from tests.line.slaves import plant, registers, slave
from tests.sim.plant import make_tag, running
from tests.sim.virtual import on_virtual_time

WRITE_WORDS = 16


@pytest.mark.parametrize("late", [0.15, 0.17, 0.25])
@on_virtual_time
async def test_a_late_reply_to_a_broadcast_acknowledges_no_write(late: float) -> None:
    """The next write of the same words is refused, while the late reply says that it was done."""
    everyone, one = ModbusRtu(station=0), ModbusRtu(station=1)
    to_all = make_tag("holding:4", everyone, type="uint32", device="all", write=WriteRule())
    own = make_tag("holding:4", one, type="uint32", write=WriteRule())
    asked = slave(one, [own, *registers(one, 3, every=1.0)])
    line = plant([asked, slave(everyone, [to_all])])
    station = line.stations[0]
    inner = station.answer or station.inner.hear
    refuses = False

    def answer(data: bytes, now: float) -> list[bytes]:
        if data[1] != WRITE_WORDS:
            return inner(data, now)
        if data[0] == 0:
            said = bytes([1]) + data[1:6]
            asyncio.get_running_loop().call_later(late, line.bench.received, said + crc16(said))
            return []
        if refuses:
            said = bytes([1, WRITE_WORDS | 0x80, 4])
            slow.append(0.2)  # seconds; its replies keep their order
            return [said + crc16(said)]
        return inner(data, now)

    slow = list[float]()
    station.answer = answer
    station.late = lambda _: slow.pop() if slow else 0.0
    async with running(line):
        await asyncio.sleep(3)
        refuses = True
        told = 0
        for _ in range(5):
            line.submit(line.line.engine.devices[1], to_all, 7)
            outcome = line.submit(asked, own, 9)
            await asyncio.sleep(3)
            told += isinstance(outcome.once, WriteResult)
            assert isinstance(outcome.once, GatewayError)
        assert told == 0
        refuses = False
        outcome = line.submit(asked, own, 9)
        await asyncio.sleep(3)
        assert isinstance(outcome.once, WriteResult)
