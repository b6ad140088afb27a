"""The waiting requests of a line: peeks wait behind all others, and take none of their places."""

import pytest

from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Confirm, Probe, Resynced, Sent
from gateway.engine.jobs.request_queue import MOST_PEEKS, MOST_WAITING, RequestQueue
from gateway.engine.jobs.requests import Command
from gateway.protocols.driver import EVERY_REQUEST, Span
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
    assert record.resyncs.seconds == 0.0
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(EVERY_REQUEST), took=0.2)
    assert record.resyncs.seconds == pytest.approx(0.2)  # it is due to the command
    rig.fail(rig.transacted())
    rig.conclude(rig.transacted(), Resynced(EVERY_REQUEST), took=0.2)
    assert record.resyncs.seconds == pytest.approx(0.2)  # to the poll


def test_the_time_of_a_write_is_counted_with_the_read_that_shows_its_outcome() -> None:
    """Only that read counted, where the write had got no reply."""
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.write("D2")
    begun = rig.now
    rig.fail(rig.transacted())
    confirm = rig.transacted()
    assert isinstance(confirm, Confirm)
    rig.conclude(confirm, Sent(held=[0]), took=0.2)
    assert rig.engine.record.requested == pytest.approx(rig.now - begun)
    assert rig.now - begun > 0.5
