"""The service: lines, Zenoh and history together, from start to SIGTERM."""

import asyncio
import gc
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import structlog

from gateway.app import Gateway
from gateway.config import Config
from gateway.history import Historian
from gateway.history.state_file import StateFile
from gateway.northbound import Northbound, StandbySettings
from gateway.tags import Sample

log = structlog.get_logger("gateway")
# Seconds. The publishing thread must not hold up the lines for Python's usual 5 ms.
SWITCH = 0.0005
# New objects until Python looks for cycles among them; every 5th time also among the older, and
# every 100th of those among all: with 50,000 tags that holds everything up for 10 ms.
COLLECT = (5000, 5, 100)

KEEP_EVERY = 10.0  # seconds
# Seconds from the signal, of the 2 there are: Zenoh takes 1.5 at most, the disk has what is left.
END_WITHIN = 1.7
KEPT_WITHIN = 0.5  # seconds that a lost state file is worth


async def run(config: Config, started: Callable[[], None] = lambda: None) -> None:
    """The service, until SIGTERM or SIGINT. Raises `GatewayError` when it cannot start.

    `started` is called when everything is open on Zenoh: once, or whenever this gateway of a
    standby group becomes active.
    """
    sys.setswitchinterval(SWITCH)
    gc.set_threshold(*COLLECT)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    while await _serve(config, stop, started):
        log.warning("from now on this gateway stands by")


async def _serve(config: Config, stop: asyncio.Event, started: Callable[[], None]) -> bool:
    """Until it is to stop, or another gateway of its group took over: then True, to start over."""
    gateway = Gateway(config)
    gc.collect()
    gc.freeze()  # tags live as long as the gateway: no need to look at them again and again
    history = _history(config)
    northbound = _northbound(config, gateway, history)
    state_file = None if config.state_file is None else StateFile(config.state_file)
    if state_file is not None:
        state_file.restore(gateway.enabled_devices)
    gateway.subscribe(northbound)
    if history is not None:  # all that is published is kept, for clients that miss it
        gateway.subscribe(_Recording(history))
        gateway.add_document("history", history.document)
    async with AsyncExitStack() as ending:  # what began last ends first
        face = asyncio.create_task(northbound.run(), name="zenoh")
        ending.push_async_callback(_put_away, face, history, state_file)
        exclusive, active, opened, replaced, stopping = events = [
            asyncio.create_task(event.wait())
            for event in (
                northbound.exclusive,
                northbound.active,
                northbound.opened,
                northbound.replaced,
                stop,
            )
        ]
        for event in events:
            ending.callback(event.cancel)
        lines: list[asyncio.Task[None]] = []
        await _first(exclusive, face, stopping)
        if exclusive.done():  # otherwise another process may have this file and these lines
            if history is not None:
                history.start()
            await _first(active, face, stopping)
            if active.done():
                lines = await _on_the_wire(gateway, history, state_file, ending)
        await _first(opened, face, stopping, replaced)
        if opened.done():
            started()
        await _first(face, stopping, replaced, *lines)
    return northbound.replaced.is_set() and not stop.is_set()


async def _first(*tasks: asyncio.Task[Any]) -> None:
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)


def _northbound(config: Config, gateway: Gateway, history: Historian | None) -> Northbound:
    group = config.standby
    return Northbound(
        config.zenoh,
        config.name,
        gateway,
        history=history,
        writers=config.writers_file,
        standby=None if group is None else StandbySettings(group, config.standby_alone),
    )


async def _on_the_wire(
    gateway: Gateway,
    history: Historian | None,
    state_file: StateFile | None,
    ending: AsyncExitStack,
) -> list[asyncio.Task[None]]:
    if history is not None:
        history.record(gateway.mirror.samples())  # "starting" marks the restart
    if state_file is not None:
        await ending.enter_async_context(_kept(state_file, gateway))
    lines = [asyncio.create_task(line.run(), name=line.engine.name) for line in gateway.lines]
    ending.push_async_callback(_ended, lines)  # first of all, so that the last outcomes go out
    return lines


@asynccontextmanager
async def _kept(state_file: StateFile, gateway: Gateway) -> AsyncIterator[None]:
    """What is learned meanwhile is written down, now and then and at the end."""
    state_file.start()
    keeping = asyncio.create_task(_keep(state_file, gateway), name="state")
    try:
        yield
    finally:
        state_file.save_last(state_file.snapshot(gateway.enabled_devices))
        await _ended([keeping])


async def _keep(state_file: StateFile, gateway: Gateway) -> None:
    while True:
        await asyncio.sleep(KEEP_EVERY)
        state_file.save_soon(state_file.snapshot(gateway.enabled_devices))


async def _put_away(
    face: asyncio.Task[None], history: Historian | None, state_file: StateFile | None
) -> None:
    """First Zenoh, so that what is told last is kept too, then the files: a disk may stand still,
    and nobody on the network shall have to wait for it."""
    by = time.monotonic() + END_WITHIN
    try:
        await _ended([face])
    finally:
        if history is not None:
            left = by - time.monotonic()
            if not await asyncio.to_thread(history.close, left):
                log.error("history did not end in time: what the disk has not taken is lost")
        if state_file is not None:
            left = min(KEPT_WITHIN, by - time.monotonic())
            if not await asyncio.to_thread(state_file.close, left):
                log.warning("the disk did not take in time what was learned of the devices")


def _history(config: Config) -> Historian | None:
    kept = config.history
    return None if kept is None else Historian(kept.path, kept.keep, kept.max_size)


class _Recording:
    """Subscribes history to what is published.

    A sample is recorded before the loop takes a question of a client that has seen it.
    """

    def __init__(self, history: Historian) -> None:
        self._history = history

    def publish(self, samples: Sequence[Sample]) -> None:
        self._history.record(samples)

    def set_online(self, device: str, online: bool) -> None:
        """History keeps no device states."""


async def _ended(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel and await; what a task failed with by itself is raised here."""
    for task in tasks:
        task.cancel()
    for outcome in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
