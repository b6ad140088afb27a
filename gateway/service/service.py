"""The service: runs lines, Zenoh and history in one process, from start to SIGTERM."""

import asyncio
import gc
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import structlog

from gateway.config import Config
from gateway.errors import GatewayError
from gateway.line.arrival import ArrivalClock
from gateway.line.line import Line
from gateway.line.send_permit import Duty
from gateway.northbound.northbound import Northbound, group_settings
from gateway.northbound.session.session import off_loop
from gateway.parts.alarms.file import AlarmFile
from gateway.parts.history import Historian
from gateway.parts.transfers import Transfers
from gateway.plant.plant import Gateway
from gateway.plant.state_file import StateFile
from gateway.service.reload import LiveReload, Reloader, RunningLines
from gateway.service.supervisor import Supervisor
from gateway.tags import Sample

log = structlog.get_logger("gateway")
# Seconds. Python's usual 5 ms of the publishing thread would delay the lines.
THREAD_SWITCH = 0.0005
# New objects before a collection of the first generation; every 5th collects the second, and
# every 100th of those all: with 50,000 tags a full collection stops the process for 10 ms.
GC_THRESHOLDS = (5000, 5, 100)

SAVE_EVERY = 10.0  # seconds
# Seconds after the signal; 2 are allowed. Zenoh takes at most 1.5, the disk gets the rest.
END_WITHIN = 1.7
STATE_FILE_WITHIN = 0.5  # seconds; a lost state file costs only a new search


async def run(config: Config, path: Path, started: Callable[[], None] = lambda: None) -> None:
    """Runs the service until SIGTERM or SIGINT. Raises `GatewayError` when it cannot start.

    SIGHUP reloads the file at `path`, unless the terminal of the process has gone. Calls `started`
    when everything is open on Zenoh: once, or each time that this gateway of a standby group
    becomes active.
    """
    sys.setswitchinterval(THREAD_SWITCH)
    gc.set_threshold(*GC_THRESHOLDS)
    stop = asyncio.Event()
    supervisor = Supervisor()
    loop = asyncio.get_running_loop()

    def end() -> None:
        log.info("gateway stopping")
        supervisor.stopping()
        stop.set()

    reloader = Reloader(path, config)
    has_terminal = sys.stderr.isatty()

    def hang_up() -> None:
        if has_terminal and not sys.stderr.isatty():
            end()
        else:
            supervisor.reloading()
            reloader.want()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end)
    loop.add_signal_handler(signal.SIGHUP, hang_up)
    withheld: Mapping[str, str] = {}
    with supervisor.informed():
        while (left := await _serve(reloader, withheld, stop, started, supervisor)) is not None:
            withheld = left
            gc.unfreeze()  # the tags of the ended gateway
            gc.collect()
            if withheld and len(withheld) == len(reloader.current.devices):
                others = " and ".join(sorted(set(withheld.values())))
                raise GatewayError(
                    f"gateway {others} serves every device of this file already: a device belongs "
                    "to one gateway, or to the gateways of one standby group"
                )
            log.warning("gateway starts over")  # the entry before says why


async def _serve(
    reloader: Reloader,
    withheld: Mapping[str, str],
    stop: asyncio.Event,
    started: Callable[[], None],
    supervisor: Supervisor,
) -> Mapping[str, str] | None:
    """Runs one gateway until `stop`, or until another gateway serves devices of the file.

    `withheld`: devices that other gateways serve. Returns them if they have changed, if a gateway
    of the standby group replaced this one, or if the event loop stood still: then it starts again.
    Otherwise None.
    """
    config = reloader.current.without(withheld)
    clock = ArrivalClock()
    duty = Duty(clock.released, shared=config.standby is not None)
    gateway = Gateway(config, clock, duty=duty, plan_now=False)
    gc.collect()
    gc.freeze()  # tags live as long as the gateway: each collection skips them
    history = _history(config)
    northbound = _northbound(config, gateway, history)
    northbound.withhold(withheld)
    web = _web(config, gateway, northbound, history)
    state_file = None if config.state_file is None else StateFile(config.state_file)
    if state_file is not None:
        state_file.restore(gateway.enabled_devices)
        gateway.mirror.restore(state_file.counters)
    alarm_file = AlarmFile(config.alarms.path, gateway.alarms)
    gateway.add_document("clock", clock.document)
    gateway.subscribe(northbound)
    transfers = _transfers(config, gateway, northbound)
    gateway.subscribe(transfers)
    if history is not None:  # clients may have missed what was published
        gateway.subscribe(_Recording(history))
        gateway.add_document("history", history.document)
    gateway.add_document("reload", reloader.document)
    running = RunningLines()
    async with AsyncExitStack() as cleanup:  # in reverse order of the start
        clock.start()
        cleanup.callback(clock.stop)
        plans = _plan_lines(gateway, cleanup)
        zenoh = asyncio.create_task(northbound.run(), name="zenoh")
        cleanup.push_async_callback(_close, zenoh, history, state_file, alarm_file)
        exclusive, active, opened, replaced, stopping, failed = events = [
            asyncio.create_task(event.wait())
            for event in (
                northbound.exclusive,
                northbound.active,
                northbound.opened,
                northbound.replaced,
                stop,
                running.failed,
            )
        ]
        ends = [zenoh, stopping, replaced, failed]
        for event in events:
            cleanup.callback(event.cancel)
        live = LiveReload(
            reloader, gateway, northbound, running, plans, supervisor, transfers.renew
        )
        await _first(exclusive, zenoh, stopping)
        if exclusive.done():  # otherwise another process may have this file and these lines
            if history is not None:
                history.start()
            supervisor.ready()  # also a standby, and a client that waits for its router
            supervisor.says("waiting for the network, or as standby")
            if web is not None:
                _start_web(web, cleanup)
            reload = asyncio.create_task(live.run(), name="reload")
            ends.append(reload)
            cleanup.push_async_callback(_end, [reload])
            await _first(active, *ends)
            if active.done():
                supervisor.says(reloader.says)
                transfers.start()  # before the alarms are restored: it has some
                await cleanup.enter_async_context(alarm_file.kept())
                await _start_lines(gateway, plans, running, history, state_file, cleanup)
                cleanup.push_async_callback(transfers.stop)  # before the lines
                cleanup.push_async_callback(_end, [reload])  # before the lines: it starts some
        await _first(opened, *ends)
        if opened.done():
            started()
        await _first(*ends)
    if northbound.namesake:
        raise GatewayError(
            f"another gateway named {config.name} serves under {config.zenoh.prefix} already: "
            "`gateway.name` must differ, and a file runs once"
        )
    return northbound.withheld if northbound.replaced.is_set() and not stop.is_set() else None


async def _first(*tasks: asyncio.Task[Any]) -> None:
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)


def _northbound(config: Config, gateway: Gateway, history: Historian | None) -> Northbound:
    return Northbound(
        config.zenoh,
        config.name,
        gateway,
        history=history,
        writers=config.writers_file,
        writers_state=config.writers_state,
        group=group_settings(config),
    )


def _transfers(config: Config, gateway: Gateway, northbound: Northbound) -> Transfers:
    write, alarms = northbound.own_writes.write, config.alarms.transfers
    return Transfers(gateway, write, config.transfers, alarms=alarms)


def _web(
    config: Config, gateway: Gateway, northbound: Northbound, history: Historian | None
) -> Callable[[], Coroutine[Any, Any, None]] | None:
    """Returns the program of the HTTP side; None without `web` in the file."""
    if config.web is None:
        return None
    from gateway.parts.web.server import Server  # imported only here: it costs time and memory
    from gateway.parts.web.sources import Sources

    sources = Sources(gateway, northbound, history, northbound.opened.is_set)
    return Server(config.web, sources).run


def _start_web(web: Callable[[], Coroutine[Any, Any, None]], cleanup: AsyncExitStack) -> None:
    serving = asyncio.create_task(web(), name="web")
    cleanup.push_async_callback(_end, [serving])


def _plan_lines(gateway: Gateway, cleanup: AsyncExitStack) -> list[asyncio.Task[None]]:
    """Plans the lines one after another, beside the event loop: each may run once it is planned."""
    turn = asyncio.Lock()

    async def plan(line: Line) -> None:
        async with turn:
            gateway.planned(line, await off_loop(gateway.plan, line))

    plans = [asyncio.create_task(plan(line), name="plan") for line in gateway.lines]
    cleanup.push_async_callback(_end, plans)
    return plans


async def _run_planned(line: Line, plan: asyncio.Task[None]) -> None:
    await plan
    await line.run()


async def _start_lines(
    gateway: Gateway,
    plans: Sequence[asyncio.Task[None]],
    running: RunningLines,
    history: Historian | None,
    state_file: StateFile | None,
    cleanup: AsyncExitStack,
) -> None:
    gateway.begin()
    if history is not None:
        history.record(gateway.mirror.samples())  # "starting" marks the restart
    if state_file is not None:
        await cleanup.enter_async_context(_saved(state_file, gateway))
    for line, plan in zip(gateway.lines, plans, strict=True):
        running.start(line, line.engine.name, _run_planned(line, plan))
    gateway.serving.restore()
    for one in gateway.serving.lines:
        running.start(one, one.name, one.run())
    cleanup.push_async_callback(running.end_all)  # first, so that the last outcomes are published


@asynccontextmanager
async def _saved(state_file: StateFile, gateway: Gateway) -> AsyncIterator[None]:
    """Saves the state file regularly, and at the end."""
    state_file.start()
    saving = asyncio.create_task(_save_regularly(state_file, gateway), name="state")
    try:
        yield
    finally:
        counters = gateway.mirror.counters()
        state_file.save_last(state_file.snapshot(gateway.enabled_devices, counters))
        await _end([saving])


async def _save_regularly(state_file: StateFile, gateway: Gateway) -> None:
    while True:
        await asyncio.sleep(SAVE_EVERY)
        counters = gateway.mirror.counters()
        state_file.save_soon(state_file.snapshot(gateway.enabled_devices, counters))


async def _close(
    zenoh: asyncio.Task[None],
    history: Historian | None,
    state_file: StateFile | None,
    alarm_file: AlarmFile,
) -> None:
    """Ends Zenoh, then the files: they keep the last outcomes too.

    A disk may hang, and clients on the network must not wait for it.
    """
    by = time.monotonic() + END_WITHIN
    try:
        await _end([zenoh])
    finally:
        if history is not None:
            left = by - time.monotonic()
            if not await asyncio.to_thread(history.close, left):
                log.error("history close timed out", so="samples that are not on disk are lost")
        closes = [alarm_file.close] if state_file is None else [alarm_file.close, state_file.close]
        for close in closes:
            left = min(STATE_FILE_WITHIN, by - time.monotonic())
            if not await asyncio.to_thread(close, left):
                log.warning("state file close timed out", so="the last changes are not saved")


def _history(config: Config) -> Historian | None:
    kept = config.history
    return None if kept is None else Historian(kept.path, kept.keep, kept.max_size)


class _Recording:
    """Records published samples in the history.

    It does so before the event loop takes the query of a client that received them.
    """

    def __init__(self, history: Historian) -> None:
        self._history = history

    def publish(self, samples: Sequence[Sample]) -> None:
        self._history.record(samples)

    def set_online(self, device: str, online: bool) -> None:
        """History keeps no device states."""


async def _end(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancels the tasks and awaits them. Raises the error of a task that failed."""
    for task in tasks:
        task.cancel()
    for outcome in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
