"""The order in which long answers work."""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager

from gateway.northbound.answering.turns import AnswerTurns, Pause, Rank

PATIENCE = 300.0  # seconds; never waited for when all is well


class Clock:
    """Stands still until it is moved."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Answer:
    """An answer on a thread of its own, which works step by step."""

    def __init__(self, turns: AnswerTurns, rank: Rank, worked: Callable[[], None]) -> None:
        self._turn: AbstractContextManager[Pause] = turns.turn(rank)
        self._worked = worked
        self.has_turn = threading.Event()
        self._may_go_on = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with self._turn as pause:
            self._worked()
            self.has_turn.set()
            assert self._may_go_on.wait(PATIENCE)
            pause()
            self._worked()

    def end(self) -> None:
        self._may_go_on.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


def waiting(turns: AnswerTurns, count: int) -> None:
    """Waits until so many answers wait for a turn."""
    while sum(map(len, turns._waiting.values())) < count:  # no answer tells that it waits
        threading.Event().wait(0.001)


def test_current_values_go_before_history() -> None:
    clock, order = Clock(), list[str]()
    turns = AnswerTurns(clock)
    first = Answer(turns, Rank.HISTORY, lambda: order.append("first"))
    assert first.has_turn.wait(PATIENCE)
    history = Answer(turns, Rank.HISTORY, lambda: order.append("history"))
    waiting(turns, 1)
    current = Answer(turns, Rank.CURRENT, lambda: order.append("current"))
    waiting(turns, 2)
    clock.now = 0.01  # longer than a slice, shorter than a client that blocks
    first._may_go_on.set()
    assert current.has_turn.wait(PATIENCE)
    assert order == ["first", "current"]
    for answer in (current, history, first):
        answer.end()
    assert sorted(order) == ["current"] * 2 + ["first"] * 2 + ["history"] * 2


def test_history_does_not_get_every_second_slice() -> None:
    clock, order = Clock(), list[str]()
    turns = AnswerTurns(clock)
    current = Answer(turns, Rank.CURRENT, lambda: order.append("current"))
    assert current.has_turn.wait(PATIENCE)
    history = Answer(turns, Rank.HISTORY, lambda: order.append("history"))
    waiting(turns, 1)
    clock.now = 0.01  # longer than a slice, shorter than a client that blocks
    current.end()
    assert history.has_turn.wait(PATIENCE)
    history.end()
    assert order == ["current", "current", "history", "history"]


def test_an_answer_that_waits_for_its_client_keeps_nobody_else_waiting() -> None:
    clock, order = Clock(), list[str]()
    turns = AnswerTurns(clock)
    blocked = Answer(turns, Rank.CURRENT, lambda: order.append("blocked"))
    assert blocked.has_turn.wait(PATIENCE)
    clock.now = 1.0
    other = Answer(turns, Rank.HISTORY, lambda: order.append("other"))
    assert other.has_turn.wait(PATIENCE)
    other.end()
    assert order == ["blocked", "other", "other"]
    blocked.end()


def test_history_gets_a_share_beside_many_current_values() -> None:
    turns = AnswerTurns(Clock())
    with turns.turn(Rank.CURRENT):
        order = list[Rank]()
        lock = threading.Lock()

        def work(rank: Rank) -> None:
            with turns.turn(rank), lock:
                order.append(rank)

        threads = [
            threading.Thread(target=work, args=(rank,))
            for rank in [Rank.HISTORY] + [Rank.CURRENT] * 20
        ]
        for thread in threads:
            thread.start()
        waiting(turns, len(threads))
    for thread in threads:
        thread.join(PATIENCE)
    assert len(order) == len(threads)
    assert 0 < order.index(Rank.HISTORY) < 10
