"""The threads that send replies."""

import asyncio
import threading
from typing import Self, cast

import zenoh

from gateway.northbound.answers import REFUSALS_LIMIT, AnswerPool
from gateway.northbound.workers import Workers

PATIENCE = 10.0  # seconds


class Query:
    """Stands for a query of Zenoh; the answers of these tests do not use it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        pass


def query() -> zenoh.Query:
    return cast("zenoh.Query", Query())


async def test_a_client_that_does_not_receive_keeps_no_other_of_its_batch_waiting() -> None:
    pool = AnswerPool(lambda _: None)
    receives, answered = threading.Event(), threading.Event()
    first, second = query(), query()
    assert pool.admit(first)
    assert pool.admit(second)

    def blocked(_: zenoh.Query) -> None:
        assert receives.wait(PATIENCE)

    pool.answer(first, blocked)
    pool.answer(second, lambda _: answered.set())
    assert await asyncio.to_thread(answered.wait, PATIENCE)
    assert not receives.is_set()
    receives.set()
    await pool.drain()
    pool.end()


def test_work_that_blocks_gets_more_threads_up_to_the_limit() -> None:
    workers = Workers(2, "test")
    go, begun = threading.Event(), threading.Semaphore(0)

    def work() -> None:
        begun.release()
        assert go.wait(PATIENCE)

    for _ in range(3):
        workers.submit(work)
    assert begun.acquire(timeout=PATIENCE)
    assert begun.acquire(timeout=PATIENCE)
    assert not begun.acquire(blocking=False)  # the third waits for a thread
    go.set()
    assert begun.acquire(timeout=PATIENCE)
    workers.end()


async def test_a_query_without_an_answer_does_not_wait_on_the_loop_for_its_client() -> None:
    """Its end is a message too: it has no room on the link of a client that does not receive."""
    receives, ended = threading.Event(), threading.Semaphore(0)

    class Deaf(Query):
        def __exit__(self, *_error: object) -> None:
            self.drop()

        def drop(self) -> None:
            assert receives.wait(PATIENCE)
            ended.release()

    pool = AnswerPool(lambda _: None)
    most = REFUSALS_LIMIT + 2
    for _ in range(most):
        pool.refuse(cast("zenoh.Query", Deaf()))
    assert pool.counters.unanswered == 2
    pool.dismiss(cast("zenoh.Query", Deaf()))
    receives.set()
    for _ in range(most + 1):
        assert await asyncio.to_thread(ended.acquire, timeout=PATIENCE)
    pool.end()
