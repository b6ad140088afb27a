"""A device that refuses everything stays online, and is told as its code."""

import asyncio
from collections.abc import Callable

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.errors import Refused
from gateway.protocols.checksums import crc16
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor.codec import Reply, encode
from gateway.tags import Quality, Reason, WriteRule
from tests.line import slaves
from tests.sim.plant import Plant, device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time


def vigor(code: str) -> Plant:
    line = plant([device([make_tag("D0", write=WriteRule()), make_tag("D5")])])
    line.stations[0].answer = lambda request, _: [encode(Reply(1, request[3:5].decode(), code))]
    return line


def k120s(code: str) -> Plant:
    driver = ModbusRtu(station=1, addressing="k120s")
    tags = [make_tag("D0000", driver, write=WriteRule()), make_tag("D0005", driver)]

    def answer(request: bytes, _now: float) -> list[bytes]:
        body = bytes((1, request[1] | 0x80, int(code)))
        return [body + crc16(body)]

    line = slaves.plant([slaves.slave(driver, tags)])
    line.stations[0].answer = answer
    return line


@pytest.mark.parametrize(
    ("made", "code", "meaning"),
    [
        (vigor, "10", "ASCII conversion error"),
        (vigor, "11", "sum check error"),
        (vigor, "14", "stop bit, parity, frame or overrun error"),
        (k120s, "03", "illegal data value"),
        (k120s, "06", "device busy"),
    ],
)
@on_virtual_time
async def test_a_device_that_refuses_everything_is_told_as_its_code(
    made: Callable[[str], Plant], code: str, meaning: str
) -> None:
    line = made(code)
    dev: Device = line.line.engine.devices[0]
    async with running(line):
        await asyncio.sleep(30)
        outcome = line.submit(dev, dev.tags[0], 3)
        await asyncio.sleep(5)
    assert line.state(dev) is State.ONLINE
    assert isinstance(outcome.once, Refused)
    assert outcome.once.code == code
    assert set(dev.record.refusals) == {code}
    for said in (str(outcome.once), *(line.now[tag].detail for tag in dev.tags)):
        assert code in said
        assert meaning in said
    for tag in dev.tags:
        assert (line.now[tag].quality, line.reason(tag)) == (Quality.BAD, Reason.REFUSED)
