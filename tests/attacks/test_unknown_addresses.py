"""A slave that lacks an address refuses it with any code, or is silent about it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from gateway.engine.device import device as engine_device
from gateway.planning.planner import Block, plan
from tests.attacks.slave import Slave, polled

NUMBERS = range(100, 120)
NEIGHBOURS = set(NUMBERS) - {107}


@pytest.mark.parametrize("exception", [1, 2, 3, 4, 9, None])
async def test_a_bad_address_leaves_its_19_neighbours_good(
    exception: int | None, tmp_path: Path
) -> None:
    slave = Slave(lambda n: n in NEIGHBOURS, exception)
    async with polled(slave, tmp_path, NUMBERS) as (line, watch):
        [device] = line.engine.devices
        bad = device.bad_addresses.bad
        await watch.until(lambda: watch.good == NEIGHBOURS and len(bad) == 1)
        [found] = bad.values()
        assert (found.span.start, found.span.size) == (107, 1)


@pytest.mark.parametrize("exception", [3, None])
async def test_an_address_that_returns_joins_its_block_again(
    exception: int | None, tmp_path: Path
) -> None:
    missing = {107}
    slave = Slave(lambda n: n not in missing, exception)
    async with polled(slave, tmp_path, NUMBERS) as (line, watch):
        [device] = line.engine.devices
        await watch.until(lambda: watch.good == NEIGHBOURS and bool(device.bad_addresses.bad))
        missing.clear()
        await watch.until(lambda: len(device.blocks) == 1 and watch.good == set(NUMBERS))
        assert device.bad_addresses.clear


@pytest.mark.parametrize("exception", [3, None])
async def test_a_block_that_is_too_long_for_the_device_is_read_in_parts(
    exception: int | None, tmp_path: Path
) -> None:
    slave = Slave(lambda n: 100 <= n < 120, exception, longest=12)
    async with polled(slave, tmp_path, NUMBERS) as (line, watch):
        [device] = line.engine.devices
        await watch.until(lambda: watch.good == set(NUMBERS) and len(device.blocks) == 2)
        assert not device.bad_addresses.bad


@pytest.mark.parametrize("numbers", [range(100, 120), [100], [100, 300, 500]])
async def test_a_slave_that_is_silent_about_other_addresses_is_read(
    numbers: list[int], tmp_path: Path
) -> None:
    """Also after its replies were lost: then a single register is read again after a silence."""
    slave = Slave(lambda n: n in numbers)
    async with polled(slave, tmp_path, numbers) as (_, watch):
        await watch.until(lambda: watch.good == set(numbers))
        slave.mute = True
        await watch.until(lambda: not watch.good)
        slave.mute = False
        await watch.until(lambda: watch.good == set(numbers))


async def test_a_slave_without_its_first_register_is_found_at_another(tmp_path: Path) -> None:
    slave = Slave(lambda n: 101 <= n < 120)
    async with polled(slave, tmp_path, NUMBERS) as (_, watch):
        await watch.until(lambda: watch.good == set(NUMBERS) - {100})


async def test_many_addresses_that_return_at_once_are_planned_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = list[int]()

    def counted(tags: Sequence[Any], *rest: Any) -> tuple[Block, ...]:
        planned.append(len(tags))
        return plan(tags, *rest)

    numbers, missing = range(100, 350), set(range(100, 350))
    slave = Slave(lambda n: n not in missing, exception=2)
    async with polled(slave, tmp_path, numbers) as (line, watch):
        [device] = line.engine.devices
        await watch.until(lambda: len(device.bad_addresses.bad) == 250)
        monkeypatch.setattr(engine_device, "plan", counted)
        missing.clear()
        await watch.until(lambda: len(device.blocks) == 2 and watch.good == set(numbers))
    assert len(planned) <= 6
