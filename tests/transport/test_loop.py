"""uvloop as the event loop of the service: an exact clock, kept silences, working ports."""

import asyncio
import importlib
import time
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any, TypeVar

import pytest

from gateway.line.channel import Channel, Echo
from gateway.line.transaction import Transaction
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from gateway.transport import SerialPath, SerialSettings, loop, open_port
from tests.conftest import lacking
from tests.sim.plant import made_device, make_tag
from tests.transport.ends import PtyMaster, RecordingReceiver
from tests.vectors import vectors

T = TypeVar("T")
REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])


@pytest.fixture
def uvloop() -> Any:
    try:
        return importlib.import_module("uvloop")
    except ImportError:
        lacking("uvloop is not installed")


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=loop.new_event_loop) as runner:
        return runner.run(coroutine)


def test_an_installed_uvloop_is_used_and_its_clock_moves_while_code_runs(
    uvloop: Any,
) -> None:
    async def within_one_callback() -> float:
        running = asyncio.get_running_loop()
        assert isinstance(running, uvloop.Loop)
        begin = running.time()
        assert abs(begin - time.monotonic()) < 0.1
        latest: float = max(running.time() - begin for _ in range(100))
        return latest

    assert 0 < run(within_one_callback()) < 0.1


def test_without_uvloop_asyncio_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_uvloop", lambda: None)

    async def which() -> str:
        return type(asyncio.get_running_loop()).__module__

    assert run(which()).startswith("asyncio.")


@pytest.mark.usefixtures("uvloop")
def test_the_silence_before_a_request_is_kept_although_timers_fire_early() -> None:
    """uvloop's timers count whole milliseconds: 1.75 ms of RTU silence would become 1 or less."""
    silence, wire = 0.00175, WireTiming(115200, 10)
    kept: list[float] = []

    class SilentPort:
        quiet_since = 0.0

        def write(self, data: bytes) -> None:
            kept.append(asyncio.get_running_loop().time() - self.quiet_since)

        async def close(self) -> None:
            pass

    async def broadcasts() -> None:
        port, driver = SilentPort(), ModbusRtu(station=0)
        timing = replace(driver.timing, silence=silence, silence_chars=0.0)
        device = made_device("all", driver, wire, timing, [make_tag("coil:0", driver)])
        channel = Channel(port, wire, WireLog(), Echo("line", None))
        for _ in range(100):
            port.quiet_since = channel.quiet_since = asyncio.get_running_loop().time()
            await driver.write(Transaction(channel, device), Span("coil", 0, 1), [1])

    run(broadcasts())
    assert len(kept) == 100
    assert min(kept) >= silence


@pytest.mark.usefixtures("uvloop")
def test_a_serial_port_works_on_uvloop() -> None:
    async def transaction() -> None:
        plug, receiver = PtyMaster(), RecordingReceiver()
        port = await open_port(SerialPath(plug.path), SerialSettings(19200, "7E1"), receiver)
        port.write(REQUEST)
        assert await plug.read(len(REQUEST)) == REQUEST
        plug.write(REPLY)
        await receiver.until(lambda r: len(r.data) >= len(REPLY))
        plug.unplug()
        await receiver.until(lambda r: bool(r.losses))
        await port.close()

    run(transaction())
