"""Which of several archivers of one store works: by the rules and tokens of a standby group.

The store decides in the end: it takes a page only after the one before it. So two archivers that do
not see each other waste work, and store nothing twice.
"""

import asyncio
import socket
import time
from collections.abc import Callable, Collection, Coroutine
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from urllib.parse import urlsplit

import zenoh

from gateway.bridges.program import say
from gateway.contract.keys import Keys
from gateway.northbound.group.election import SETTLE_TIME, Election, Role, RoleToken, State
from gateway.northbound.group.standby import GroupTokens

_DECIDE_EVERY = 0.2  # seconds
_TOKENS = {State.CLAIMING: (Role.CLAIM,), State.ACTIVE: (Role.CLAIM, Role.ACTIVE)}
_SAID = {
    State.STANDBY: "another archiver of this store is at work: this one waits",
    State.ACTIVE: "this archiver is at work",
    State.REPLACED: "another archiver of this store may be at work: this one begins again",
}


def group_of(store: str) -> str:
    """Returns the name of the group of all archivers of a store."""
    if "://" not in store:
        store = Path(store).resolve().as_uri()
    parts = urlsplit(store.rstrip("/"))
    place = f"{parts.scheme}://{parts.hostname}:{parts.port}" if parts.hostname else parts.scheme
    return f"archive-{sha256(f'{place}{parts.path}?{parts.query}'.encode()).hexdigest()[:12]}"


class Turn:
    """The tokens of this archiver, and what it sees of the others."""

    def __init__(self, session: zenoh.Session, prefix: str, group: str) -> None:
        self._session = session
        self._group = GroupTokens(Keys(prefix, socket.gethostname()), group, None)
        self._name = socket.gethostname()
        self._others: set[RoleToken] = set()
        self._declared: dict[Role, zenoh.LivelinessToken] = {}
        self._election = self._new()
        loop = asyncio.get_running_loop()

        def changed(token: zenoh.Sample) -> None:
            key, is_there = str(token.key_expr), token.kind == zenoh.SampleKind.PUT
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._changed, key, is_there)

        self._subscriber = session.liveliness().declare_subscriber(
            self._group.all, zenoh.handlers.Callback(changed, indirect=False), history=True
        )

    async def run(self, work: Callable[[], Coroutine[None, None, None]]) -> None:
        """Does the work while it is the turn of this archiver, until it is cancelled."""
        running: asyncio.Task[None] | None = None
        try:
            while True:
                before, state = self._election.state, self._election.decide(time.monotonic())
                if state is not before and state in _SAID:
                    say(_SAID[state])
                if state is State.ACTIVE and running is None:
                    running = asyncio.create_task(work())
                if running is not None and (state is not State.ACTIVE or running.done()):
                    await _end(running)
                    running = None
                if state is State.REPLACED:
                    self._election = self._new()
                await asyncio.to_thread(self._declare, _TOKENS.get(state, ()))
                await asyncio.sleep(_DECIDE_EVERY)
        finally:
            if running is not None:
                await _end(running)

    def _new(self) -> Election:
        # It does not wait for late tokens: the store refuses the second archiver.
        begun = time.monotonic() - SETTLE_TIME
        session = str(self._session.zid())
        election = Election(self._name, session, begun, needs_link=False)
        for token in self._others:
            election.token_changed(token, present=True)
        return election

    def _changed(self, key: str, is_there: bool) -> None:
        if (token := self._group.parse(key, time.monotonic())) is not None:
            change = self._others.add if is_there else self._others.discard
            change(token)
            self._election.token_changed(token, is_there)

    def _declare(self, wanted: Collection[Role]) -> None:
        for role in self._declared.keys() - set(wanted):
            self._declared.pop(role).undeclare()  # type: ignore[no-untyped-call]  # the stub lacks it
        for role in wanted:
            if role not in self._declared:
                key = self._group.key(RoleToken(role, self._name, self._election.session))
                self._declared[role] = self._session.liveliness().declare_token(key)


async def _end(work: asyncio.Task[None]) -> None:
    """Raises what the work has raised."""
    work.cancel()
    with suppress(asyncio.CancelledError):
        await work
