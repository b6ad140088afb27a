"""The waiting requests of a line: peeks wait behind all others, and take none of their places."""

from gateway.engine.jobs.request_queue import MOST_PEEKS, MOST_WAITING, RequestQueue
from gateway.engine.jobs.requests import Command
from gateway.protocols.driver import Span
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
