"""Reading and writing without a running gateway: the command line opens the port itself."""

import asyncio
import time
from collections.abc import Sequence

from gateway.app import device_of, opener
from gateway.config import Config, DeviceConfig, LineConfig
from gateway.device import Device
from gateway.errors import GatewayError, LineDown
from gateway.line import Line
from gateway.tags import Reason, Sample, Tag, Written
from gateway.values import Value


class _Once:
    """Upstairs for a line that lives until every wanted tag has been heard of."""

    def __init__(self, wanted: Sequence[Tag]) -> None:
        self.heard: dict[Tag, Sample] = {}
        self.all_heard = asyncio.Event()
        self._wanted = set(wanted)

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.tag in self._wanted and sample.reason is not Reason.STARTING:
                self.heard[sample.tag] = sample
        if len(self.heard) == len(self._wanted):
            self.all_heard.set()

    def alive(self, device: Device, alive: bool) -> None:
        pass


async def read(config: Config, tags: Sequence[Tag]) -> list[Sample]:
    """One sample of each tag, good or bad, in the order asked."""
    found: dict[Tag, Sample] = {}
    for line_config in config.lines:
        wanted = [tag for tag in tags if tag in line_config.tags]
        if wanted:
            once = _Once(wanted)
            task = asyncio.create_task(_line(line_config, wanted, once).run())
            await once.all_heard.wait()
            await _end(task)
            found |= once.heard
    return [found[tag] for tag in tags]


async def write(config: Config, tag: Tag, value: Value) -> Written:
    """Raises `GatewayError` when it was not done, or nobody knows."""
    units = tag.encode(value)
    (line_config,) = (line for line in config.lines if tag in line.tags)
    once = _Once([tag])
    line = _line(line_config, [tag], once)
    (device,) = line.devices
    device.blocks = ()  # nothing is to be read
    task = asyncio.create_task(line.run())
    while not line.is_open and not once.heard:
        await asyncio.sleep(0.01)
    outcome: asyncio.Future[Written | GatewayError] = asyncio.get_running_loop().create_future()
    line.submit(device, tag, units, outcome.set_result)
    result = await outcome
    await _end(task)
    if isinstance(result, GatewayError):
        raise result
    return result


def _line(config: LineConfig, tags: Sequence[Tag], once: _Once) -> Line:
    names = {tag.device for tag in tags}
    devices = [_narrowed(device, tags, config) for device in config.devices if device.name in names]
    return Line(
        config.name, devices, config.wire, opener(config), once, time.time_ns, echo=config.echo
    )


def _narrowed(device: DeviceConfig, tags: Sequence[Tag], line: LineConfig) -> Device:
    """The device with the wanted tags alone."""
    found = device_of(device, line)
    found.tags = tuple(tag for tag in tags if tag.device == device.name)
    found.plan()
    return found


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    for outcome in await asyncio.gather(task, return_exceptions=True):
        if isinstance(outcome, LineDown):
            raise outcome
