"""The threads that send replies."""

import asyncio
import threading
from pathlib import Path
from typing import Self, cast

import pytest
import zenoh

from gateway.contract.access.named_secrets import NamedSecrets
from gateway.northbound.answering.answers import REFUSALS_LIMIT, AnswerPool, Workers
from gateway.plant.threads import off_loop
from tests.northbound.access import secret

PATIENCE = 300.0  # seconds; never waited for when all is well


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


async def test_refusals_do_not_wait_on_the_loop_for_a_client_and_each_gets_its_error() -> None:
    """The end of a query is a message too: it has no room on the link of a deaf client."""
    receives, ended, refused = threading.Event(), threading.Semaphore(0), threading.Semaphore(0)

    class Deaf(Query):
        def __exit__(self, *_error: object) -> None:
            self.drop()

        def drop(self) -> None:
            assert receives.wait(PATIENCE)
            ended.release()

    pool = AnswerPool(lambda _: refused.release())
    most = REFUSALS_LIMIT + 2
    for _ in range(most):
        pool.refuse(cast("zenoh.Query", Deaf()))
    pool.dismiss(cast("zenoh.Query", Deaf()))
    receives.set()
    for _ in range(most + 1):
        assert await asyncio.to_thread(ended.acquire, timeout=PATIENCE)
    for _ in range(most):
        assert refused.acquire(blocking=False)
    pool.end()


async def test_a_refusal_after_the_session_has_closed_ends_no_thread() -> None:
    replied = threading.Semaphore(0)

    def closed(_: zenoh.Query) -> None:
        replied.release()
        raise zenoh.ZError("session closed")

    pool = AnswerPool(closed)
    pool.refuse(query())
    assert await asyncio.to_thread(replied.acquire, timeout=PATIENCE)
    pool.end()


def _no_thread(_: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_without_more_threads_of_the_system_the_first_one_works(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    workers, ran = Workers(2, "test"), threading.Semaphore(0)
    with monkeypatch.context() as none_left:
        none_left.setattr(threading.Thread, "start", _no_thread)
        for _ in range(9):
            workers.submit(ran.release)
        for _ in range(9):
            assert ran.acquire(timeout=PATIENCE)
    # The system has some again: two works that wait for each other need two threads.
    both = threading.Barrier(2)
    for _ in range(2):
        workers.submit(both.wait, PATIENCE)
    workers.submit(ran.release)
    assert ran.acquire(timeout=PATIENCE)
    assert not both.broken
    workers.end()


async def test_files_are_read_although_the_system_has_no_thread_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert await off_loop(len, "one") == 3
    monkeypatch.setattr(threading.Thread, "start", _no_thread)
    assert await off_loop(len, "three") == 5
    with pytest.raises(ZeroDivisionError):
        await off_loop(divmod, 1, 0)
    assert await off_loop(len, "again") == 5


def test_a_secret_is_withdrawn_although_the_system_has_no_thread_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = secret(tmp_path / "writers.txt", f"alice:{'a' * 20}\n")
    secrets = NamedSecrets(file, "writers.file")
    file.write_text("")
    monkeypatch.setattr(threading.Thread, "start", _no_thread)
    monkeypatch.setattr("gateway.contract.access.named_secrets._CHECK_EVERY", 0.0)
    assert secrets.current() == {}
