"""One timer for all time-outs of a line: never late, and called once for each end."""

import asyncio
from collections.abc import Callable

from gateway.line.channel import NEVER, Alarm
from tests.sim.virtual import now, on_virtual_time


def noting(rung: list[float], *again: float) -> Callable[[], float]:
    """Who looks, and the times to look again that it asks for, one after another."""
    answers = list(again)

    def look() -> float:
        rung.append(now())
        return answers.pop(0) if answers else NEVER

    return look


@on_virtual_time
async def test_it_goes_off_in_time_and_only_once() -> None:
    rung: list[float] = []
    start = now()
    Alarm().by(start + 0.5, noting(rung))
    await asyncio.sleep(10)
    assert rung == [start + 0.5]


@on_virtual_time
async def test_who_says_so_is_called_again() -> None:
    rung: list[float] = []
    start = now()
    Alarm().by(start + 0.5, noting(rung, start + 2, start + 3))
    await asyncio.sleep(10)
    assert rung == [start + 0.5, start + 2, start + 3]


@on_virtual_time
async def test_an_earlier_end_than_the_one_waited_for_is_not_missed() -> None:
    rung: list[float] = []
    alarm, start = Alarm(), now()
    alarm.by(start + 5, noting(rung))
    alarm.by(start + 1, noting(rung))
    await asyncio.sleep(10)
    assert rung == [start + 1]


@on_virtual_time
async def test_a_later_end_is_looked_for_by_the_last_who_asked() -> None:
    """The timer of the first is left running: whoever looks then says when to come again."""
    before: list[float] = []
    rung: list[float] = []
    alarm, start = Alarm(), now()
    alarm.by(start + 1, noting(before))
    alarm.by(start + 5, noting(rung, start + 5))
    await asyncio.sleep(10)
    assert before == []
    assert rung == [start + 1, start + 5]
