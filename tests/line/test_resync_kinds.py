"""A station that is silent about its loopback is resynced by reads of another length."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from itertools import count, islice
from typing import Any

import pytest

from gateway.errors import NoReply
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.resync_kind import ResyncKind
from gateway.tags import Quality, WriteResult, WriteRule
from tests.line.test_one_silent_address import NUMBERS, Partly, plant_of
from tests.sim.links import commands, link_device, link_plant, spelt
from tests.sim.plant import Plant, running
from tests.sim.virtual import on_virtual_time


def clone(*addresses: str, **settings: Any) -> tuple[Plant, Any]:
    """A plant with one station that says nothing about the commands in `silent`."""
    device = link_device(ComputerLink(station=5), *addresses, every=0.5, **settings)
    return link_plant([device]), device


def silence(line: Plant, *silent: str) -> None:
    """Lets the station receive these commands and say nothing."""
    station: Any = line.stations[0].inner
    answer = type(station)._answer
    # Private: no setting of the station loses single commands.
    station._answer = lambda text: None if text[4:6] in silent else answer(station, text)


@pytest.mark.parametrize("addresses", [["D10"], ["D10", "D100", "M0"], ["M0"], ["C200"]])
@on_virtual_time
async def test_a_clone_that_is_silent_about_tt_comes_online_and_stays(addresses: list[str]) -> None:
    line, device = clone(*addresses)
    silence(line, "TT")
    async with running(line):
        await asyncio.sleep(10)
        assert line.good(device)
        for _ in range(5):  # each fault ends in a resync
            line.stations[0].mute = True
            await asyncio.sleep(3)
            assert not line.good(device)
            line.stations[0].mute = False
            await asyncio.sleep(6)
            assert line.good(device)
        assert commands(line.stations[0]).count("TT") < 12


@on_virtual_time
async def test_a_verified_write_to_such_a_clone_is_told_as_written() -> None:
    line, device = clone("D10", "D20", write=WriteRule(verify=True, repeat=True))
    silence(line, "TT")
    async with running(line):
        await asyncio.sleep(10)
        for value in range(20):
            outcome = line.submit(device, spelt(device, "D20"), value)
            await asyncio.sleep(3)
            assert isinstance(outcome.once, WriteResult), outcome
            assert line.stations[0].memory.read("D", 20) == [value]


@on_virtual_time
async def test_a_station_that_answers_tt_gets_no_other_resync_and_another_one_is_learned() -> None:
    line, device = clone("D10")
    async with running(line):
        await asyncio.sleep(5)
        for silent in ((), ("TT",), ("WR",), ()):  # replaced by another one each time
            silence(line, "TT", "WR", "BR")
            await asyncio.sleep(20)
            silence(line, *silent)
            await asyncio.sleep(20)
            assert line.good(device) is (silent != ("WR",))


class Looping(Partly):
    """A Modbus slave with all registers, which may be silent about function 08."""

    loops = True
    heard = looped = 0  # requests by function 08, and replies to them
    lose = 0  # requests that are lost

    def _meant(self, data: bytes) -> bool:
        if self.lose:
            self.lose -= 1
            return True
        if self.pdu_of(data)[0] != 8:
            return False
        self.heard += 1
        self.looped += self.loops and not self.inner.mute
        return not self.loops


class SlaveLine:
    """A line with a slave whose file says that it has function 08."""

    def __init__(self, protocol: str) -> None:
        echo = {} if protocol == "modbus-tcp" else {"echo": False}
        self._plant = plant_of(protocol, 2, self._made, echo, diagnostics=True)
        self.slave: Looping

    def _made(self, inner: Any, framing: str) -> Looping:
        self.slave = Looping(inner, framing)
        return self.slave

    @asynccontextmanager
    async def running(self, *, loops: bool) -> AsyncIterator[None]:
        task = asyncio.create_task(self._plant.lines[0].run())
        await asyncio.sleep(0)
        self.slave.loops = loops
        yield
        task.cancel()

    @property
    def good(self) -> bool:
        tags = [self._plant.tag(f"meter/t{n}") for n in NUMBERS]
        return all(tag and self._plant.sample(tag).quality is Quality.GOOD for tag in tags)

    async def interrupt(self, seconds: float) -> None:
        self.slave.inner.mute = True
        await asyncio.sleep(seconds)
        assert not self.good
        self.slave.inner.mute = False
        await asyncio.sleep(10)
        assert self.good


each_framing = pytest.mark.parametrize("protocol", ["modbus-rtu", "modbus-ascii", "modbus-tcp"])


@each_framing
@on_virtual_time
async def test_a_slave_that_is_silent_about_function_08_comes_online_and_stays(
    protocol: str,
) -> None:
    """It was offline for ever: each resync was by function 08."""
    line = SlaveLine(protocol)
    async with line.running(loops=False):
        await asyncio.sleep(10)
        assert line.good
        for _ in range(10):
            await line.interrupt(3)
        assert line.slave.heard < 20


@each_framing
@on_virtual_time
async def test_a_slave_with_function_08_is_resynced_by_it_also_after_an_outage(
    protocol: str,
) -> None:
    line = SlaveLine(protocol)
    async with line.running(loops=True):
        await asyncio.sleep(10)
        for seconds in range(30, 36):
            await line.interrupt(seconds)
            for _ in range(3):
                before, line.slave.lose = line.slave.looped, 1
                await asyncio.sleep(5)
                assert line.slave.looped == before + 1


@on_virtual_time
async def test_a_slave_that_refuses_function_08_is_resynced_by_reads() -> None:
    """A refusal names no request: each resync waited for a quiet wire."""
    line = SlaveLine("modbus-rtu")
    async with line.running(loops=True):
        line.slave.inner.diagnostics = False
        await asyncio.sleep(10)
        assert line.good
        for _ in range(20):
            line.slave.lose = 1
            await asyncio.sleep(5)
            assert line.good
        assert line.slave.heard < 12


class Station:
    """What a station answers, and the kinds of the resyncs that it gets."""

    def __init__(self) -> None:
        self.kind, self._tokens = ResyncKind(), count(2, 2)

    def resyncs(self, number: int, *, loops: bool, reads: bool) -> list[bool]:
        """Returns the kind of each of so many resyncs: True for loopbacks."""
        kinds = []
        for token in islice(self._tokens, number):
            kinds.append(loopback := self.kind.is_loopback(token))
            with suppress(NoReply), self.kind.sent(token, loopback=loopback):
                if not (loops if loopback else reads):
                    raise NoReply("no reply")
            assert self.kind.is_loopback(token + 1) is loopback  # its reply is judged afterwards
        return kinds


def test_the_belief_begins_without_evidence_and_silence_ends_it() -> None:
    station, loops, reads = Station(), True, False
    assert station.resyncs(3, loops=True, reads=True) == [loops] * 3
    assert station.resyncs(3, loops=False, reads=True) == [loops] * 3  # noise may do this
    assert station.resyncs(9, loops=True, reads=True) == [loops] * 9
    found = station.resyncs(20, loops=False, reads=True)
    assert found.index(reads) >= 4
    assert found.count(loops) < 12
    assert found[-5:] == [reads] * 5
    assert station.resyncs(4, loops=True, reads=False) == [reads, reads, loops, loops]


@pytest.mark.parametrize("lost", range(20))
def test_a_read_that_ends_an_outage_is_no_evidence_against_the_loopback(lost: int) -> None:
    for before in (0, 5):  # good ones
        station = Station()
        station.resyncs(before, loops=True, reads=True)
        station.resyncs(lost, loops=False, reads=False)
        assert station.resyncs(4, loops=True, reads=True)[1:] == [True] * 3
