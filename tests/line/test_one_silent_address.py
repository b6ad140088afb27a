"""A device that is silent about one address loses this tag alone."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import pytest

from gateway.config import LineConfig, built
from gateway.engine.forecast import dark_for
from gateway.plant.plant import Plant
from gateway.protocols.modbus import rtu
from gateway.protocols.modbus.ascii import AsciiCodec
from gateway.protocols.modbus.frame import Frame
from gateway.tags import Quality
from tests.line.slaves import station_of
from tests.sim.bench import Bench
from tests.sim.virtual import now, on_virtual_time

NUMBERS = (100, 200, 300, 400, 500)
SILENT = 300
NOTHING: Mapping[str, Any] = MappingProxyType({})


class Partly:
    """A slave that says nothing about one register."""

    silent: tuple[int, ...] = (SILENT,)

    def __init__(self, inner: Any, framing: str) -> None:
        self.inner = inner
        self.framing = framing
        self.delay = 0.0

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if self._meant(data):
            return []
        replies: list[bytes] = self.inner.hear(data, at)
        return replies

    def _meant(self, data: bytes) -> bool:
        pdu = self.pdu_of(data)
        start, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return pdu[0] == 3 and any(start <= n < start + count for n in self.silent)

    def pdu_of(self, data: bytes) -> bytes:
        match self.framing:
            case "modbus-rtu":
                return data[1:-2]
            case "modbus-ascii":
                return bytes.fromhex(data[1:-4].decode())[1:]
            case _:
                return data[7:]


def plant_of(
    protocol: str,
    retries: int,
    kind: Callable[[Any, str], Partly] = Partly,
    line: Mapping[str, Any] = NOTHING,
    numbers: Sequence[int] = NUMBERS,
    **settings: Any,
) -> Plant:
    tags = {f"t{n}": {"address": f"holding:{n}", "every": "1s"} for n in numbers}
    device = {"protocol": protocol, "station": 1, "retries": retries, "tags": tags, **settings}
    port = "tcp://127.0.0.1:1502" if protocol == "modbus-tcp" else "tcp://127.0.0.1:4001"
    hall = {"port": port, "baudrate": 19200, "devices": {"meter": device}, **line}
    config = built({"lines": {"hall": hall}})

    def opener(line: LineConfig) -> Any:
        [settings] = line.devices
        driver: Any = settings.driver  # one of the three of Modbus
        station = kind(station_of(driver), protocol)
        bench = Bench()
        return lambda receiver: bench.open([station], line.wire, receiver)

    return Plant(config, lambda: int(now() * 1e9), opener)


async def looked_at(plant: Plant, after: float, looks: int) -> dict[int, int]:
    """Returns how often each register was good, once a second from `after` seconds on."""
    [line] = plant.lines
    task = asyncio.create_task(line.run())
    await asyncio.sleep(after)
    tags = {int(tag.name[1:]): tag for tag in line.engine.devices[0].tags}
    good = dict.fromkeys(tags, 0)
    for _ in range(looks):
        await asyncio.sleep(1)
        for n, tag in tags.items():
            good[n] += plant.sample(tag).quality is Quality.GOOD
    task.cancel()
    return good


@pytest.mark.parametrize("retries", [0, 1, 2])
@pytest.mark.parametrize("protocol", ["modbus-rtu", "modbus-ascii", "modbus-tcp"])
@on_virtual_time
async def test_one_silent_register_costs_its_tag_alone(protocol: str, retries: int) -> None:
    """With `retries: 1` the device was offline again and again: the resync read beside it."""
    plant = plant_of(protocol, retries)
    good = await looked_at(plant, after=30, looks=120)
    assert good.pop(SILENT) == 0
    assert min(good.values()) >= (115 if retries == 2 else 105), good


class FallsSilent(Partly):
    """A slave that says nothing about the register from a minute on."""

    def __init__(self, inner: Any, framing: str) -> None:
        super().__init__(inner, framing)
        self._from = now() + 60

    def _meant(self, data: bytes) -> bool:
        return now() >= self._from and super()._meant(data)


@pytest.mark.parametrize("retries", [0, 1, 2])
@pytest.mark.parametrize("protocol", ["modbus-rtu", "modbus-ascii", "modbus-tcp"])
@pytest.mark.parametrize("block", [range(SILENT, SILENT + 5), range(SILENT - 4, SILENT + 1)])
@on_virtual_time
async def test_a_silent_register_at_one_end_of_the_only_block_costs_its_tag_alone(
    block: range, protocol: str, retries: int
) -> None:
    """Resyncs read at that end too, so the device went offline within each search: it was dark."""
    plant = plant_of(protocol, retries, FallsSilent, numbers=block)
    [device] = plant.lines[0].engine.devices
    dark = dark_for(device, device.load)  # as `check` says
    assert dark is not None
    good = await looked_at(plant, after=60 + dark, looks=60)
    assert good.pop(SILENT) == 0
    assert min(good.values()) >= 50, good


@pytest.mark.parametrize("retries", [0, 1, 2])
@pytest.mark.parametrize("silent", [(200, 300), (100, 200, 300), (300, 400, 500), (100, 300, 500)])
@on_virtual_time
async def test_several_silent_registers_among_five_single_ones_cost_their_tags_alone(
    silent: tuple[int, ...], retries: int
) -> None:
    """The first one was asked first whenever the device came online, so nothing was ever read."""
    kind: type[Partly] = type("SilentAboutSome", (Partly,), {"silent": silent})
    plant = plant_of("modbus-rtu", retries, kind)
    good = await looked_at(plant, after=300, looks=90)
    assert {good.pop(n) for n in silent} == {0}
    assert min(good.values()) >= 60, good


class Confused(Partly):
    """A slave that refuses the register with an exception to function 04, whatever was sent."""

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if not self._meant(data):
            return super().hear(data, at)
        pdu = bytes((0x84, 2))
        match self.framing:
            case "modbus-rtu":
                return [rtu.encode(Frame(data[0], pdu))]
            case "modbus-ascii":
                return [AsciiCodec().encode(Frame(int(data[1:3], 16), pdu))]
        return [data[:4] + bytes((0, 3, data[6])) + pdu]


@pytest.mark.parametrize("retries", [0, 1, 2])
@pytest.mark.parametrize("protocol", ["modbus-rtu", "modbus-ascii", "modbus-tcp"])
@on_virtual_time
async def test_a_register_refused_with_the_code_of_another_function_costs_its_tag_alone(
    protocol: str, retries: int
) -> None:
    """All tags were bad for most of the time, and a second master was blamed."""
    plant = plant_of(protocol, retries, Confused)
    good = await looked_at(plant, after=30, looks=120)
    assert good.pop(SILENT) == 0
    assert min(good.values()) >= 115, good
    [device] = plant.lines[0].engine.devices
    [bad] = device.bad_addresses.bad.values()
    assert bad.how == "refused with 02"
    assert not device.is_doubtful


class Bridge(Partly):
    """A bridge that says late, with exception 0B, that the unit is silent about two registers."""

    def hear(self, data: bytes, at: float) -> list[bytes]:
        start, count = int.from_bytes(data[8:10]), int.from_bytes(data[10:12])
        silent = any(start <= n < start + count for n in (100, 200))
        self.delay = 0.6 if silent else 0.0
        if silent:
            return [data[:4] + bytes((0, 3, data[6], data[7] | 0x80, 0x0B))]
        return super().hear(data, at)


@on_virtual_time
async def test_a_bridge_that_tells_late_of_two_silent_registers_loses_these_alone() -> None:
    """Both were asked first whenever the unit came back: all tags were bad, for ever."""
    plant = plant_of("modbus-tcp", 1, Bridge)
    good = await looked_at(plant, after=180, looks=60)
    assert good[100] == good[200] == good[SILENT] == 0
    assert min(good[400], good[500]) >= 55, good
