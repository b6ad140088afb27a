"""The waiting requests of a line: peeks wait behind all others, and take none of their places."""

import pytest

from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Sent
from gateway.engine.jobs.request_queue import MOST_PEEKS, MOST_WAITING, RequestQueue
from gateway.engine.jobs.requests import Command
from gateway.protocols.driver import Span
from tests.engine.rig import Rig
from tests.sim.plant import device


def command(name: str, span: Span | None = None) -> Command:
    return Command(DEVICE, name, "", 0.0, span=span)


DEVICE = device([])
PEEKED = Span("D", 0, 1)


def test_a_peek_waits_behind_commands_that_came_later() -> None:
    queue = RequestQueue()
    for name, span in (("1", PEEKED), ("run", None), ("2", PEEKED), ("stop", None)):
        assert queue.submit(command(name, span))
    names = [one.name for one in queue.waiting if isinstance(one, Command)]
    assert names == ["run", "stop", "1", "2"]


def test_each_kind_has_its_own_places() -> None:
    queue = RequestQueue()
    peeks = [queue.submit(command("peek", PEEKED)) for _ in range(MOST_PEEKS + 1)]
    assert peeks == [True] * MOST_PEEKS + [False]
    assert queue.has_room(MOST_WAITING)
    assert not queue.has_room(MOST_WAITING + 1)
    commands = [queue.submit(command("run")) for _ in range(MOST_WAITING + 1)]
    assert commands == [True] * MOST_WAITING + [False]
    assert not queue.has_room(1)


def test_the_time_of_requests_is_counted_with_their_time_outs_and_that_of_polls_is_not() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    record = rig.engine.record
    rig.conclude(rig.transacted(), [0] * 6, took=0.3)
    assert record.requested == 0.0
    rig.write("D0")
    rig.conclude(rig.transacted(), Sent(), took=0.25)
    assert record.requested == pytest.approx(0.25)
    rig.conclude(rig.transacted(), [0] * 6)  # the poll that shows the written value
    rig.command()
    rig.fail(rig.transacted())
    assert record.requested == pytest.approx(0.25 + 0.6)
