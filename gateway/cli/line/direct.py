"""Reads, writes and commands without a running gateway: opens the port in this process.

Commands import it only with `--direct`: it drives lines, which a client of a gateway does not need.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Collection, Coroutine, Iterable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from typing import Any, TypeVar

from gateway.cli.client import NoGateway, connected
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.terminal import err
from gateway.config import Config, LineConfig
from gateway.config.commands import check_command, line_of
from gateway.engine.device.device import Device
from gateway.engine.forecast import unsolicited_tags
from gateway.engine.jobs.requests import WRITE_EXPIRY, CommandResult
from gateway.errors import BadValue, GatewayError, LineDown
from gateway.line.groups import ended
from gateway.line.line import Line, SampleSink
from gateway.plant import build
from gateway.tags import Reason, Sample, Tag, WriteResult, bad
from gateway.tags.mirror import Mirror
from gateway.values import Value

T = TypeVar("T")
SERVED = "is on a served line: only the running gateway has it, without --direct"
LISTEN_FOR = 5.0  # seconds, for unsolicited frames
WRITE_WITHIN = 30.0  # seconds for several tags


class _Once:
    """Receives the samples of a line until it has one of every wanted tag."""

    def __init__(self, wanted: AbstractSet[Tag] = frozenset()) -> None:
        self.heard: dict[Tag, Sample] = {}
        self.all_heard = asyncio.Event()
        self.wanted = wanted

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.reason is not Reason.STARTING:
                self.heard[sample.tag] = sample
        if self.wanted <= self.heard.keys():
            self.all_heard.set()

    def online(self, device: Device, online: bool) -> None:
        """The samples say all that counts here."""


def alone(config: Config) -> None:
    """Raises `GatewayError` while the gateway of the file runs: a wire has one master."""
    with suppress(NoGateway), connected(config, err.print) as client:
        client.status()
        raise GatewayError("the gateway of this file runs, and has the ports: leave out --direct")


def run(talk: Coroutine[Any, Any, T]) -> T:
    """Runs one of the functions below, and logs errors only."""
    set_up(LogFormat.TEXT, LogLevel.ERROR)
    return asyncio.run(talk)


async def read(config: Config, tags: Sequence[Tag]) -> list[Sample]:
    """Returns one sample of each tag, good or bad, in the order of `tags`."""
    known = _with_inputs(tags)
    found: dict[Tag, Sample] = {}
    for line_config in config.lines:
        enabled = {device.name for device in line_config.devices if device.enabled}
        own = set(line_config.tags)
        mine = [tag for tag in known if tag in own and not tag.origin.inputs]
        if line_config.serve:  # a request on the wire of a master would disturb it
            found |= {tag: bad(tag, Reason.LINE_DOWN, time.time_ns(), SERVED) for tag in mine}
            continue
        wanted = [tag for tag in mine if tag.device in enabled]
        found |= {tag: bad(tag, Reason.DISABLED, time.time_ns()) for tag in mine}
        found |= {tag: bad(tag, Reason.STARTING, time.time_ns()) for tag in wanted}
        found |= await _read(line_config, wanted)
    mirror = Mirror(known, time.time_ns())
    mirror.follow(mirror.update(found.values()))
    return [mirror[tag] for tag in tags]


def _with_inputs(tags: Iterable[Tag]) -> list[Tag]:
    """Returns the tags, and those that their values are made of, each once."""
    known: dict[Tag, None] = {}
    for tag in tags:
        known |= dict.fromkeys((*_with_inputs(tag.origin.inputs), tag))
    return list(known)


async def _read(config: LineConfig, tags: Sequence[Tag]) -> dict[Tag, Sample]:
    """The samples of tags that can be read; a tag in no request has none."""
    once = _Once()
    line = _line(config, {tag.device for tag in tags}, tags, once)
    devices = line.engine.devices
    polled = {tag for device in devices for block in device.blocks for tag in block.tags}
    unsolicited = {tag for device in devices for tag in unsolicited_tags(device)}
    if polled | unsolicited:
        once.wanted = polled
        async with _running(line):
            if polled:
                await once.all_heard.wait()
            await _listen(once, unsolicited)
    return once.heard


async def _listen(once: _Once, unsolicited: AbstractSet[Tag]) -> None:
    """Waits a while for unsolicited values: a scale streams, a bar code may never arrive."""
    once.all_heard.clear()
    once.wanted |= unsolicited
    once.samples(())
    with suppress(TimeoutError):
        async with asyncio.timeout(LISTEN_FOR):
            await once.all_heard.wait()


async def follow(config: Config, sink: SampleSink) -> None:
    """Reads all tags at their intervals until it is cancelled."""
    lines = [build.line_of(line, line.devices, sink) for line in config.lines if not line.serve]
    await asyncio.gather(*(line.run() for line in lines))


async def write_group(
    config: Config, values: Sequence[tuple[Tag, Value]]
) -> list[WriteResult | GatewayError]:
    """Writes tags of one device in their order; returns the outcome of each.

    Raises `GatewayError`; `BadValue` only before anything is sent.
    """
    units, tags = [(tag, tag.encode(value)) for tag, value in values], [tag for tag, _ in values]
    first = tags[0]
    (line_config,) = (line for line in config.lines if first in line.tags)
    if line_config.serve:
        raise BadValue(f"{first.key} {SERVED}")
    if not any(device.enabled for device in line_config.devices if device.name == first.device):
        raise BadValue(f"device {first.device} is disabled")
    line = _line(line_config, {first.device}, tags, _Once())
    async with _running_idle(line) as device:
        writes = line.write_group(device, units, WRITE_EXPIRY + line.dialling)
        return await ended(writes, WRITE_WITHIN + line.dialling)


async def control(config: Config, device: str, command: str, argument: str) -> CommandResult:
    """Sends one command. Raises `GatewayError`; `BadValue` only before anything is sent."""
    check_command(config, device, command)
    line_config = line_of(config, device)
    line = _line(line_config, {device}, line_config.tags, _Once())
    async with _running_idle(line) as commanded:
        loop = asyncio.get_running_loop()
        started = loop.time()
        within = WRITE_EXPIRY + line.dialling
        answer = await line.command(commanded, command, argument, within)
        return CommandResult(answer, time.time_ns(), loop.time() - started)


def _line(config: LineConfig, devices: Collection[str], tags: Sequence[Tag], once: _Once) -> Line:
    """The line with these devices, each with only the given tags."""
    chosen = [
        replace(device, tags=tuple(tag for tag in tags if tag.device == device.name))
        for device in config.devices
        if device.name in devices
    ]
    return build.line_of(config, chosen, once)


@asynccontextmanager
async def _running_idle(line: Line) -> AsyncIterator[Device]:
    """Opens the line of one device, and polls nothing."""
    (device,) = line.engine.devices
    device.poll_nothing()
    async with _running(line):
        await line.tried.wait()
        yield device


@asynccontextmanager
async def _running(line: Line) -> AsyncIterator[None]:
    task = asyncio.create_task(line.run())
    try:
        yield
    finally:
        task.cancel()
        for outcome in await asyncio.gather(task, return_exceptions=True):
            if isinstance(outcome, LineDown):
                raise outcome
