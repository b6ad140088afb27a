"""A Computer Link clone that is silent about the loopback TT: reads of another length resync it."""

import asyncio
from typing import Any

import pytest

from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.resync import ResyncKind
from gateway.tags import WriteResult, WriteRule
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


def test_the_belief_begins_without_evidence_and_silence_ends_it() -> None:
    kind = ResyncKind()
    assert all(kind.is_loopback(token) for token in range(0, 20, 2))
    kind.unanswered(loopback=True)
    assert [kind.is_loopback(token) for token in (0, 2, 4, 6)] == [True, False] * 2
    kind.answered(loopback=True)
    assert all(kind.is_loopback(token) for token in range(0, 20, 2))
    for _ in range(3):
        kind.unanswered(loopback=True)
        assert kind.is_loopback(2)  # it has answered TT before: three lost replies are few
    kind.unanswered(loopback=True)
    assert not kind.is_loopback(2)
    kind.answered(loopback=False)
    assert not any(kind.is_loopback(token) for token in range(0, 20, 2))
    kind.unanswered(loopback=False)
    kind.unanswered(loopback=False)
    assert kind.is_loopback(0)
