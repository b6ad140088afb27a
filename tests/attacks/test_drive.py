"""A frequency inverter: it limits set points and says so, and has registers that are only written.

It shares no code with the gateway, except the line that polls it over a real connection.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gateway.engine.device.health import State
from gateway.engine.results.request_rules import Differs
from gateway.errors import GatewayError, Offline, Refused, Unclear
from gateway.line.line import Line
from gateway.tags import WriteResult
from tests.attacks.slave import Slave, Watch, crc, polled

SETPOINT, MOST, COMMAND = 0x2001, 100, 0x2000


@dataclass
class Drive(Slave):
    """Writes above `MOST` are limited. `refuses`: the exception to every write."""

    refuses: int | None = None
    named: int = 6  # the function that the exception names
    echoes: bool = False  # from the next write on it is off, and the adapter returns what is sent
    _off: bool = False
    held: dict[int, int] = field(default_factory=dict)

    def _reply(self, request: bytes) -> bytes:
        self._off = self.echoes and (self._off or request[1] == 6)
        if self._off:
            return request
        if request[1] != 6:
            return super()._reply(request)
        if self.refuses is not None:
            reply = bytes((1, 0x80 | self.named, self.refuses))
            return reply + crc(reply)
        number, value = int.from_bytes(request[2:4]), int.from_bytes(request[4:6])
        self.held[number] = min(value, MOST)
        reply = request[:4] + self.held[number].to_bytes(2)
        return reply + crc(reply)


@asynccontextmanager
async def running(
    drive: Drive, folder: Path, tags: dict[int, dict[str, Any]], **settings: Any
) -> AsyncIterator[tuple[Line, Watch]]:
    settings = {"write_single": True, "retries": 0, **settings}
    async with polled(drive, folder, {10: {}, **tags}, **settings) as (line, watch):
        yield line, watch


async def written(line: Line, number: int, value: int) -> WriteResult | GatewayError:
    [device] = line.engine.devices
    [tag] = [tag for tag in device.tags if tag.address.number == number]
    try:
        return await line.write(device, tag, tag.encode(value))
    except GatewayError as error:
        return error


@pytest.mark.parametrize("verify", [False, True])
async def test_a_limited_set_point_differs_and_the_values_stay_good(
    verify: bool, tmp_path: Path
) -> None:
    """It was `unclear` in hex, every tag was bad, and a second master was blamed."""
    drive = Drive(lambda n: n in (10, 11))
    tags: dict[int, dict[str, Any]] = {11: {"write": {"verify": verify}}}
    async with running(drive, tmp_path, tags) as (line, watch):
        [device] = line.engine.devices
        await watch.until(lambda: watch.good == {10, 11})
        outcome = await written(line, 11, 500)
        assert isinstance(outcome, Differs)
        assert str(outcome) == (
            "acknowledged, but the device now holds 11" if verify else "the device took 100"
        )
        assert isinstance(await written(line, 11, 11), WriteResult)
        assert device.state is State.ONLINE
        assert device.diagnosis() == ""
        assert watch.good == {10, 11}


@pytest.mark.parametrize("exception", [2, None])
async def test_a_register_that_is_only_written_is_never_read_and_its_write_is_done(
    exception: int | None, tmp_path: Path
) -> None:
    drive = Drive(lambda n: n == 10, exception)
    tags = {SETPOINT: {"write": True, "poll": False}}
    async with running(drive, tmp_path, tags) as (line, watch):
        await watch.until(lambda: watch.good == {10})
        for value in (50, 51, 51, 50):
            assert isinstance(await written(line, SETPOINT, value), WriteResult)
        assert drive.held == {SETPOINT: 50}
        assert watch.good == {10}
    assert not any(first <= SETPOINT < first + count for first, count in drive.requests)


@pytest.mark.parametrize("exception", [1, None])
async def test_a_device_that_is_only_written_is_alive_when_it_acknowledges(
    exception: int | None, tmp_path: Path
) -> None:
    """It answers no read, or refuses all: its first write went nowhere."""
    drive = Drive(lambda n: False, exception)
    tags = {SETPOINT: {"write": True, "poll": False}}
    async with polled(drive, tmp_path, tags, echo=False, write_single=True) as (line, _):
        [device] = line.engine.devices
        await line.tried.wait()
        assert isinstance(await written(line, SETPOINT, 50), WriteResult)
        assert device.state is State.ONLINE
        assert drive.requests == []
        drive.mute = True
        assert isinstance(await written(line, SETPOINT, 51), GatewayError)
        drive.mute = False
        outcome = await written(line, SETPOINT, 52)  # behind a read that it may refuse
        assert isinstance(outcome, WriteResult if exception else Offline)


@pytest.mark.parametrize("code", [1, 2, 3])
async def test_the_code_of_a_device_that_refuses_everything_is_the_answer(
    code: int, tmp_path: Path
) -> None:
    """A resync after the second write was refused too: "two replies arrived", but one came."""
    drive = Drive(lambda n: False, code, refuses=code)
    async with polled(drive, tmp_path, {11: {"write": True}}, write_single=True) as (line, watch):
        await watch.until(lambda: 11 in watch.last)
        for value in (5, 5, 6):
            outcome = await written(line, 11, value)
            assert isinstance(outcome, Refused), outcome
            assert outcome.code == f"{code:02X}"
        with suppress(IndexError):
            assert "two" not in line.engine.devices[0].diagnosis()


async def test_a_write_refused_with_the_code_of_another_function_is_unclear_and_values_stay_good(
    tmp_path: Path,
) -> None:
    """All tags turned bad, and a second master was blamed."""
    drive = Drive(lambda n: n in (10, 11), refuses=2, named=3)
    tags: dict[int, dict[str, Any]] = {10: {}, 11: {"write": True}}
    tags = {n: {**settings, "every": "1h"} for n, settings in tags.items()}  # writes go first
    async with running(drive, tmp_path, tags) as (line, watch):
        await watch.until(lambda: watch.good == {10, 11})
        for value in (5, 6, 7):
            outcome = await written(line, 11, value)
            assert isinstance(outcome, Unclear)
            assert str(outcome) == "exception 02 to function 03, which was not sent"
            assert watch.good == {10, 11}
        [device] = line.engine.devices
        assert not device.is_doubtful


@pytest.mark.parametrize("echoes", [False, True])
async def test_a_write_that_begins_a_connection_is_acknowledged_unless_it_is_an_echo(
    echoes: bool, tmp_path: Path
) -> None:
    """With `close_after: round` each write of one register was unclear, although it was done."""
    drive = Drive(lambda n: n in (10, 11))
    tags: dict[int, dict[str, Any]] = {10: {"every": "10s"}, 11: {"every": "10s", "write": True}}
    async with running(drive, tmp_path, tags, close_after="round") as (line, watch):
        await watch.until(lambda: watch.good == {10, 11})
        assert isinstance(await written(line, 11, 11), WriteResult)
        drive.echoes = echoes
        outcome = await written(line, 11, 11)
        assert isinstance(outcome, Unclear if echoes else WriteResult)
