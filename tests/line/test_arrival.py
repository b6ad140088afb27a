"""The wall clock of samples stays behind while the loop is late."""

import asyncio
import socket
import time
from collections.abc import Callable
from itertools import pairwise

import pytest
import structlog

from gateway.line.arrival import PERIOD, ArrivalClock
from gateway.transport.loop import new_event_loop
from tests.sim.virtual import on_virtual_time

LATE = 0.3  # seconds that the loop stands still


@on_virtual_time
async def test_on_time_it_is_the_wall_clock() -> None:
    loop = asyncio.get_running_loop()
    clock = ArrivalClock(lambda: int(loop.time() * 1e9))
    assert clock() == int(loop.time() * 1e9)
    clock.start()
    for _ in range(50):
        await asyncio.sleep(0.037)
        assert clock() == pytest.approx(loop.time() * 1e9, abs=1e5)
    clock.stop()
    assert clock() == int(loop.time() * 1e9)


async def test_a_jump_of_the_wall_clock_is_logged_and_a_slow_correction_is_not() -> None:
    ahead = 0.0  # seconds
    clock = ArrivalClock(lambda: time.monotonic_ns() + int(ahead * 1e9))
    with structlog.testing.capture_logs() as logged:
        clock.start()
        for step in (0.1, 0.1, 3600.0, 0.1, -7200.0, 0.0):
            ahead += step
            await asyncio.sleep(1.2 * PERIOD)
        clock.stop()
    jumps = [entry["seconds"] for entry in logged if entry["event"] == "clock jumped"]
    assert jumps == pytest.approx([3600.0, -7200.0], abs=0.3)


@pytest.mark.parametrize("factory", [asyncio.new_event_loop, new_event_loop])
def test_bytes_that_waited_get_the_time_before_the_loop_stood_still(
    factory: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def attack() -> None:
        clock, stamps = ArrivalClock(), [0]
        near, far = await pair(lambda: stamps.append(clock()))
        clock.start()
        await asyncio.sleep(PERIOD / 2)
        far.write(b"x")
        arrived = time.time_ns()
        time.sleep(LATE)  # the attack
        stamps.append(clock())
        while len(stamps) < 3:
            await asyncio.sleep(0)
        stamps.append(clock())
        await asyncio.sleep(2 * PERIOD)
        stamps.append(clock())
        clock.stop()
        near.close()
        far.close()
        assert max(stamps[:4]) <= arrived + (PERIOD + 0.05) * 1e9
        assert all(late - early > -1e6 for early, late in pairwise(stamps))  # two clocks
        assert stamps[-1] > arrived + LATE * 1e9

    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(attack())


async def pair(
    received: Callable[[], None],
) -> tuple[asyncio.Transport, asyncio.Transport]:
    """Two ends of a connection; `received` is called when bytes arrive at the first."""

    class Ear(asyncio.Protocol):
        def data_received(self, data: bytes) -> None:
            received()

    one, two = socket.socketpair()
    loop = asyncio.get_running_loop()
    near, _ = await loop.create_connection(Ear, sock=one)
    far, _ = await loop.create_connection(asyncio.Protocol, sock=two)
    return near, far
