"""Reads, writes and commands without a running gateway: opens the port in this process."""

import asyncio
import time
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress

from gateway.app import device_of, opener
from gateway.config import Config, LineConfig
from gateway.config.commands import check_command, line_of
from gateway.engine.device import Device, DeviceSettings
from gateway.engine.requests import CommandResult
from gateway.engine.unsolicited import listened
from gateway.errors import BadValue, GatewayError, LineDown
from gateway.line.line import Line
from gateway.tags import Reason, Sample, Tag, WriteResult, bad
from gateway.values import Value

LISTEN_FOR = 5.0  # seconds, for unsolicited frames


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

    def alive(self, device: Device, alive: bool) -> None:
        pass


async def read(config: Config, tags: Sequence[Tag]) -> list[Sample]:
    """Returns one sample of each tag, good or bad, in the order of `tags`."""
    found: dict[Tag, Sample] = {}
    for line_config in config.lines:
        enabled = {device.name for device in line_config.devices if device.enabled}
        mine = [tag for tag in tags if tag in line_config.tags]
        wanted = [tag for tag in mine if tag.device in enabled]
        found |= {tag: bad(tag, Reason.DISABLED, time.time_ns()) for tag in mine}
        found |= {tag: bad(tag, Reason.STARTING, time.time_ns()) for tag in wanted}
        found |= await _read(line_config, wanted)
    return [found[tag] for tag in tags]


async def _read(config: LineConfig, tags: Sequence[Tag]) -> dict[Tag, Sample]:
    """Returns samples of the tags that can be read. Tags of no block are left out."""
    line = _line(config, tags, once := _Once())
    asked = {tag for device in line.devices for block in device.blocks for tag in block.tags}
    unasked = {tag for device in line.devices for tag in listened(device)}
    if asked | unasked:
        once.wanted = asked
        task = asyncio.create_task(line.run())
        if asked:
            await once.all_heard.wait()
        await _listen(once, unasked)
        await _end(task)
    return once.heard


async def _listen(once: _Once, unasked: AbstractSet[Tag]) -> None:
    """Waits a while for unsolicited values: a scale streams, a bar code may never arrive."""
    once.all_heard.clear()
    once.wanted |= unasked
    once.samples(())
    with suppress(TimeoutError):
        async with asyncio.timeout(LISTEN_FOR):
            await once.all_heard.wait()


async def write(config: Config, tag: Tag, value: Value) -> WriteResult:
    """Writes one tag. Raises `GatewayError`; `BadValue` only before anything is sent."""
    units = tag.encode(value)
    (line_config,) = (line for line in config.lines if tag in line.tags)
    if not any(device.enabled for device in line_config.devices if device.name == tag.device):
        raise BadValue(f"device {tag.device} is disabled")
    once = _Once({tag})
    line = _line(line_config, [tag], once)
    (device,) = line.devices
    device.blocks = ()  # read nothing
    task = asyncio.create_task(line.run())
    while not line.is_open and not once.heard:
        await asyncio.sleep(0.01)
    outcome: asyncio.Future[WriteResult | GatewayError] = asyncio.get_running_loop().create_future()
    line.submit(device, tag, units, outcome.set_result)
    result = await outcome
    await _end(task)
    if isinstance(result, GatewayError):
        raise result
    return result


async def control(config: Config, device: str, command: str, argument: str) -> CommandResult:
    """Sends one command. Raises `GatewayError`; `BadValue` only before anything is sent."""
    check_command(config, device, command)
    line_config = line_of(config, device)
    line = _line(line_config, [tag for tag in line_config.tags if tag.device == device], _Once())
    (told,) = line.devices
    told.blocks = ()  # read nothing
    task = asyncio.create_task(line.run())
    while not line.is_open and not line.record.trouble:
        await asyncio.sleep(0.01)
    loop = asyncio.get_running_loop()
    started = loop.time()
    outcome: asyncio.Future[str | GatewayError] = loop.create_future()
    line.command(told, command, argument, outcome.set_result)
    result = await outcome
    await _end(task)
    if isinstance(result, GatewayError):
        raise result
    return CommandResult(result, time.time_ns(), loop.time() - started)


def _line(config: LineConfig, tags: Sequence[Tag], once: _Once) -> Line:
    names = {tag.device for tag in tags}
    devices = [_narrowed(device, tags, config) for device in config.devices if device.name in names]
    return Line(
        config.name, devices, config.wire, opener(config), once, time.time_ns, echo=config.echo
    )


def _narrowed(device: DeviceSettings, tags: Sequence[Tag], line: LineConfig) -> Device:
    """Returns the device with only the given tags."""
    found = device_of(device, line)
    found.tags = tuple(tag for tag in tags if tag.device == device.name)
    found.plan()
    return found


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    for outcome in await asyncio.gather(task, return_exceptions=True):
        if isinstance(outcome, LineDown):
            raise outcome
