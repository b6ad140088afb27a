"""The service's own parts: history subscribes, tasks end, and their errors are raised."""

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from gateway.parts.history.part import HistoryPart
from gateway.service import service
from gateway.tags import good
from tests.history.recorded import history
from tests.sim.plant import make_tag

SECOND = 1_000_000_000


def test_published_samples_are_recorded(tmp_path: Path) -> None:
    tag = make_tag("D0", history=True)
    now = time.time_ns()
    with history(tmp_path / "history.db") as historian:
        plant: Any = None  # only its start is recorded
        recording = HistoryPart(plant, historian)
        recording.set_online("plc", False)
        recording.publish([good(tag, 7, now)])
        found = list(historian.samples(tag, "[..]", None, now + SECOND))
    assert [sample.value for sample in found] == [7]


async def test_the_end_awaits_every_task_and_raises_the_error_of_one_that_failed() -> None:
    ended: list[str] = []

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("endless")

    async def failed() -> None:
        raise OSError("no port")

    tasks = [asyncio.create_task(endless()), asyncio.create_task(failed())]
    await asyncio.sleep(0)
    with pytest.raises(OSError, match="no port"):
        await service._end(tasks)  # no public part of the service ends tasks alone
    assert ended == ["endless"]
    assert all(task.done() for task in tasks)
