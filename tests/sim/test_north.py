"""The northbound edge on virtual time: a short part of `make sim PACE=north`, and its Zenoh."""

import asyncio
import os
import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Any

import pytest

from tests.sim.north import run
from tests.sim.pipe import OVERHEAD, Limits, Pipe, Rank
from tests.sim.threads import Turns
from tests.sim.virtual import VirtualLoop, now, on_virtual_time
from tests.sim.virtual_threading import Threading

ROOT = Path(__file__).parents[2]
LIMITS = Limits((8192, 8192, 1000), batch=500, drop_after=0.05, close_after=3.0)


@pytest.mark.parametrize("seed", [7, 9, 12])
def test_half_a_minute_of_faults_breaks_no_rule(seed: int) -> None:
    story = run(seed, 1 / 120, traced=False)
    assert not story.broken, "\n".join([story.replay(), *story.broken])


def test_the_runs_of_a_seed_are_equal_in_spite_of_threads() -> None:
    """Also in another process, whose hashes differ."""
    ask = "from tests.sim.north import run; print(run(6, 0.002, calm=2.0).trace)"
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    other = subprocess.run(
        [sys.executable, "-c", ask], cwd=ROOT, env=environment, capture_output=True, check=True
    )
    assert run(6, 0.002, calm=2.0).trace == other.stdout.decode().strip()


class Bench:
    """A pipe of 1000 bytes per second, and what arrives."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.turns = Turns(loop)
        self.arrived: list[str] = []
        self.pipe = Pipe(*(self.turns, LIMITS, 1000.0, 0.0, 500, self.arrived.append, self._close))

    def _close(self) -> None:
        self.pipe.close()

    def fill(self, count: int) -> None:
        for n in range(count):
            self.pipe.force(Rank.VALUE, str(n), 250 - OVERHEAD)

    async def on_thread(self, *steps: Any) -> list[Any]:
        """Runs the steps on one thread. Returns their results."""
        results: list[Any] = []
        thread: Any = vars(Threading(self.turns))["Thread"](
            lambda: results.extend(step() for step in steps)
        )
        thread.start()
        while thread.is_alive():
            await asyncio.sleep(0.01)
        self.turns.end()
        return results


def put(bench: Bench, content: str, rank: Rank = Rank.VALUE) -> bool:
    return bench.pipe.put(rank, content, 250 - OVERHEAD, block=rank is Rank.ANSWER)


@on_virtual_time
async def test_a_value_without_room_is_lost_after_the_limit_and_the_next_at_once() -> None:
    bench = Bench()
    bench.pipe.set_rate(0.0)
    bench.fill(6)  # two are on the wire, four wait
    took: list[float] = []

    def timed() -> bool:
        began = bench.turns.loop.time()
        done = put(bench, "late")
        took.append(bench.turns.loop.time() - began)
        return done

    assert await bench.on_thread(timed, timed) == [False, False]
    assert took[0] >= LIMITS.drop_after
    assert took[1] == 0.0
    assert bench.pipe.lost == 2


@on_virtual_time
async def test_room_is_free_when_a_whole_batch_has_left() -> None:
    bench = Bench()
    bench.fill(6)
    began = now()
    assert await bench.on_thread(
        lambda: put(bench, "lost"),
        lambda: bench.turns.wait(deque(), 0.5),  # a batch of 500 bytes leaves
        lambda: put(bench, "sent"),
    ) == [False, False, True]
    await asyncio.sleep(began + 3.0 - now())
    assert bench.arrived == ["0", "1", "2", "3", "4", "5", "sent"]


@on_virtual_time
async def test_an_answer_waits_and_goes_before_values() -> None:
    bench = Bench()
    bench.fill(4)
    assert await bench.on_thread(lambda: put(bench, "answer", Rank.ANSWER)) == [True]
    await asyncio.sleep(2.0)
    assert bench.arrived == ["0", "1", "answer", "2", "3"]


@on_virtual_time
async def test_a_link_without_progress_is_closed_under_a_waiting_answer() -> None:
    bench = Bench()
    bench.pipe.set_rate(0.0)
    for _ in range(40):
        bench.pipe.force(Rank.ANSWER, "before", 250 - OVERHEAD)
    began = now()
    assert await bench.on_thread(lambda: put(bench, "answer", Rank.ANSWER)) == [False]
    assert bench.pipe.closed
    assert now() - began > LIMITS.close_after - 0.001


@on_virtual_time
async def test_the_event_loop_must_not_wait_for_a_thread() -> None:
    bench = Bench()
    bench.pipe.set_rate(0.0)
    bench.fill(6)
    with pytest.raises(RuntimeError, match="the event loop waits"):
        put(bench, "late")
