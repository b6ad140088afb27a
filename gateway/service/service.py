"""The service: runs the plant, Zenoh and the parts in one process, from start to SIGTERM."""

import asyncio
import gc
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import structlog

from gateway.config import Config, load
from gateway.errors import GatewayError
from gateway.line.arrival import ArrivalClock
from gateway.line.line import Line
from gateway.line.send_permit import SendPermit
from gateway.northbound.northbound import Files, Northbound, group_settings
from gateway.parts.registry import kinds
from gateway.plant.part import Phase
from gateway.plant.plant import Plant
from gateway.plant.threads import off_loop
from gateway.service.bulkheads import Bulkheads
from gateway.service.reload import LiveReload, Reloader, RunningLines
from gateway.service.supervisor import Supervisor
from gateway.transport.device_servers import close_doors

log = structlog.get_logger("gateway")
# Seconds. Python's usual 5 ms of the publishing thread would delay the lines.
THREAD_SWITCH = 0.0005
# New objects before a collection of the first generation; every 5th collects the second, and
# every 100th of those all: with 50,000 tags a full collection stops the process for 10 ms.
GC_THRESHOLDS = (5000, 5, 100)

# Seconds after the signal; 2 are allowed. Zenoh takes at most 1.5, the disk gets the rest.
END_WITHIN = 1.7


async def run(
    config: Config,
    path: Path,
    started: Callable[[], None] = lambda: None,
    read: Callable[[Path], Config] = load,
) -> None:
    """Runs the service until SIGTERM or SIGINT. Raises `GatewayError` when it cannot start.

    SIGHUP has the file at `path` read again, unless the terminal has gone. Calls `started`
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

    reloader = Reloader(path, config, read=read)
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
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGHUP])  # one that came during the start
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
    duty = SendPermit(clock.released, shared=config.standby is not None)
    plant = Plant(config, clock, duty=duty, plan_now=False)
    gc.collect()
    gc.freeze()  # tags live as long as the gateway: each collection skips them
    parts = Bulkheads(plant)
    northbound = Northbound(
        config.zenoh,
        config.name,
        plant,
        parts=parts,
        files=Files(config.writers_file, config.writers_state, config.folder),
        group=group_settings(config),
    )
    admission = northbound.admission
    admission.claiming.withhold(withheld)
    plant.subscribe(northbound)
    plant.subscribe(parts)  # clients may have missed what was published
    plant.doors.documents.append(lambda: {"clock": clock.document(), "reload": reloader.document()})
    outdated = asyncio.Event()

    def start_over(why: str) -> None:
        log.warning("gateway outdated", why=why)
        outdated.set()

    parts.make(kinds(), northbound, start_over, reloader)
    async with AsyncExitStack() as cleanup:  # in reverse order of the start
        clock.start()
        cleanup.callback(clock.stop)
        await parts.restore()
        plans = _plan_lines(plant, cleanup)
        zenoh = asyncio.create_task(northbound.run(), name="zenoh")
        cleanup.push_async_callback(_close, zenoh, parts)
        running = RunningLines()
        live = LiveReload(reloader, plant, northbound, running, plans, supervisor, parts)
        exclusive, active, opened, replaced, stopping, failed, old = events = [
            asyncio.create_task(event.wait())
            for event in (
                northbound.exclusive,
                admission.active,
                northbound.opened,
                admission.replaced,
                stop,
                running.failed,
                outdated,
            )
        ]
        ends = [zenoh, stopping, replaced, failed, old]
        for event in events:
            cleanup.callback(event.cancel)
        await _first(exclusive, zenoh, stopping)
        if exclusive.done():  # otherwise another process may have this file and these lines
            supervisor.ready()  # also a standby, and a client that waits for its router
            supervisor.says("waiting for the network, or as standby")
            await parts.start(Phase.KEEPING, Phase.SHOWING)
            cleanup.push_async_callback(parts.stop, Phase.SHOWING)
            reload = asyncio.create_task(live.run(), name="reload")
            ends.append(reload)
            cleanup.push_async_callback(_end, [reload])
            await _first(active, *ends)
            if active.done():
                supervisor.says(reloader.says)
                plant.begin()
                parts.activate()
                await parts.start(Phase.ACTIVE, Phase.DRIVING)
                for line, plan in zip(plant.lines, plans, strict=True):
                    running.start(line, line.engine.name, _run_planned(line, plan))
                cleanup.callback(close_doors)  # a standby accepts no device server
                cleanup.push_async_callback(running.end_all)  # before Zenoh: the last outcomes
                cleanup.push_async_callback(parts.stop, Phase.DRIVING)
                cleanup.push_async_callback(_end, [reload])  # before the lines: it starts some
        await _first(opened, *ends)
        if opened.done():
            started()
        await _first(*ends)
    if admission.claiming.namesake:
        raise GatewayError(
            f"another gateway named {config.name} serves under {config.zenoh.prefix} already: "
            "`gateway.name` must differ, and a file runs once"
        )
    again = admission.replaced.is_set() or outdated.is_set()
    return admission.claiming.withheld if again and not stop.is_set() else None


async def _first(*tasks: asyncio.Task[Any]) -> None:
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)


def _plan_lines(plant: Plant, cleanup: AsyncExitStack) -> list[asyncio.Task[None]]:
    """Plans the lines one after another, beside the event loop: each may run once it is planned."""
    turn = asyncio.Lock()

    async def plan(line: Line) -> None:
        async with turn:
            plant.planned(line, await off_loop(plant.plan, line))

    plans = [asyncio.create_task(plan(line), name="plan") for line in plant.lines]
    cleanup.push_async_callback(_end, plans)
    return plans


async def _run_planned(line: Line, plan: asyncio.Task[None]) -> None:
    await plan
    await line.run()


async def _close(zenoh: asyncio.Task[None], parts: Bulkheads) -> None:
    """Ends Zenoh, then the parts with files: they keep the last outcomes too.

    A disk may hang, and clients on the network must not wait for it.
    """
    by = time.monotonic() + END_WITHIN
    try:
        await _end([zenoh])
    finally:
        await parts.stop(Phase.KEEPING, Phase.ACTIVE, within=by - time.monotonic())


async def _end(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancels the tasks and awaits them. Raises the error of a task that failed."""
    for task in tasks:
        task.cancel()
    for outcome in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
