"""The watchdog of the event loop."""

import asyncio
import threading
from typing import Any

import pytest

from gateway.northbound.session import watchdog
from gateway.northbound.session.watchdog import Watchdog


class Session:
    """The part of a session that the watchdog uses."""

    def __init__(self) -> None:
        self.closed = threading.Event()

    def close(self) -> None:
        self.closed.set()


async def test_it_closes_the_sessions_while_the_loop_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watchdog, "LIMIT", 0.3)
    own: Any = Session()
    second: Any = Session()
    returned = asyncio.Event()
    watch = Watchdog(lambda: [own, second], returned.set)
    with watch.watching():
        assert second.closed.wait(60)  # holds the loop
        assert own.closed.is_set()
        assert not returned.is_set()
        async with asyncio.timeout(300):
            await returned.wait()
    assert watch.has_fired


async def test_a_loop_that_turns_keeps_its_sessions() -> None:
    session: Any = Session()
    watch = Watchdog(lambda: [session], lambda: None)
    with watch.watching():
        await asyncio.to_thread(session.closed.wait, 0.6)
    assert not watch.has_fired


async def test_it_ends_with_its_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "LIMIT", 0.0)
    session: Any = Session()
    watch = Watchdog(lambda: [session], lambda: None)
    with watch.watching():
        pass
    assert not session.closed.wait(0.6)  # the loop stands still now
