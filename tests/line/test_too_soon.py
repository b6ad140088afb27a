"""Reads of requests that get a copy of another reply, sooner than the station can reply."""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.errors import Busy, Unclear
from gateway.protocols.driver import AnyDriver, Span
from gateway.tags import Tag, WriteRule
from tests.line.device_server import DRIVERS, TURNAROUND, DeviceServer, behind, by_protocol
from tests.sim.bench import WIRE
from tests.sim.plant import Plant, make_tag, running
from tests.sim.virtual import on_virtual_time

PLANNED, NEW, OTHER = 100, 200, 300  # addresses


@dataclass
class Copying(DeviceServer):
    """Sends a copy of the last reply of a length with a request, before the station replies."""

    replies: list[bytes] = field(default_factory=list)
    copied: int = 0  # its reply is copied with the request after so many more
    requests: int = 0

    def received(self, data: bytes) -> None:
        self.replies.append(data)
        super().received(data)

    def copy_in(self, requests: int) -> None:
        """Sends the copy of the last reply with the request after so many others."""
        self.requests, self.copied = requests, len(self.replies)

    def write(self, data: bytes) -> None:
        super().write(data)
        if self.copied and not self.requests:
            copy, self.copied = self.replies[self.copied - 1], 0
            after = (len(data) + len(copy)) * WIRE.character + 0.2 * TURNAROUND
            asyncio.get_running_loop().call_later(after, super().received, copy)
        self.requests -= 1


async def prepared(
    driver: AnyDriver, text: str, **settings: Any
) -> tuple[Copying, Plant, Device, Any, Tag]:
    """A line whose tag is at `PLANNED`, with a poll of `OTHER` that holds 55."""
    area = "holding:" if driver.protocol.startswith("modbus") else "D"
    other = make_tag(f"{area}{OTHER}", driver, name="other", type="uint16", every=1.0)
    tag = make_tag(f"{area}{text}", driver, name="tag", every=60.0, **settings)
    server = Copying()
    line, dev, memory = behind(server, driver, other, tag)
    memory.write(area.strip(":"), OTHER, [55])
    return server, line, dev, memory, tag


async def after_a_poll(server: Copying) -> None:
    """Waits until the next poll of `OTHER` has its reply, and for quiet after it."""
    count = len(server.replies)
    while len(server.replies) == count:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.4)


@by_protocol
@pytest.mark.parametrize("kept", [False, True])
@on_virtual_time
async def test_a_read_back_that_comes_too_soon_confirms_nothing(
    driver: AnyDriver, kept: bool
) -> None:
    """The station acknowledges 55 and does not keep it, or it keeps 66: the copy says 55."""
    server, line, dev, memory, tag = await prepared(
        driver, str(PLANNED), type="uint16", write=WriteRule(verify=True)
    )
    area = tag.address.area
    async with running(line):
        await asyncio.sleep(70)  # the turnaround is known
        await after_a_poll(server)
        server.copy_in(1)
        outcome = line.submit(dev, tag, 66 if kept else 55)
        if not kept:
            while server.copied:
                await asyncio.sleep(0.0001)
                memory.write(area, PLANNED, [0])
            memory.write(area, PLANNED, [0])
        await asyncio.sleep(5)
    if kept:
        assert outcome.once.verified
    else:
        assert isinstance(outcome.once, Unclear)


@by_protocol
@on_virtual_time
async def test_a_peek_that_is_answered_too_soon_gets_no_other_value(driver: AnyDriver) -> None:
    server, line, dev, memory, tag = await prepared(driver, str(PLANNED), type="uint16")
    memory.write(tag.address.area, NEW, [77])
    async with running(line):
        await asyncio.sleep(70)
        for _ in range(3):
            await after_a_poll(server)
            server.copy_in(0)
            with suppress(Unclear, Busy):
                assert await line.line.peek(dev, Span(tag.span.area, NEW, 1), 5.0) == "77"


@pytest.mark.parametrize("driver", DRIVERS[2:], ids=lambda driver: driver.protocol)
@on_virtual_time
async def test_a_bit_is_not_written_into_another_word(driver: AnyDriver) -> None:
    """The word that is read before comes too soon: its other bits would be those of a copy."""
    server, line, dev, memory, tag = await prepared(
        driver, f"{PLANNED}.3", type="bool", write=WriteRule()
    )
    memory.write(tag.address.area, PLANNED, [0x1000])
    async with running(line):
        await asyncio.sleep(70)
        await after_a_poll(server)
        server.copy_in(0)
        line.submit(dev, tag, True)
        await asyncio.sleep(5)
    assert list(memory.read(tag.address.area, PLANNED)) in ([0x1000], [0x1008])
