"""Everything below Zenoh, made from a configuration: lines, and what is known of every tag."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

from gateway import __version__
from gateway.config import Config, LineConfig
from gateway.config.commands import check_command, every_command, speaker
from gateway.engine.device import Device, DeviceSettings
from gateway.engine.forecast import LineForecast, forecast
from gateway.engine.jobs import Poll
from gateway.engine.requests import CommandResult
from gateway.errors import Busy, GatewayError, Offline
from gateway.line.line import Line
from gateway.northbound.status import Document, device_document, line_document
from gateway.simulator.plant import station_for
from gateway.simulator.port import open_simulator
from gateway.tags import Quality, Reason, Sample, Tag, WriteResult, bad
from gateway.tags.mirror import Mirror
from gateway.tags.timestamps import rfc3339
from gateway.transport import Port, Receiver, SimulatorAddress, open_port
from gateway.values import Value

T = TypeVar("T")
FRESH_WITHIN = 5.0  # seconds a reading may take that somebody waits for


def device_of(config: DeviceSettings, line: LineConfig) -> Device:
    return Device(
        name=config.name,
        driver=config.driver,
        wire=line.wire,
        timing=config.timing,
        tags=config.tags,
        late_guard=config.late_guard,
        verify_reads=config.verify_reads,
        turnaround=config.turnaround,
        control=config.control,
    )


def opener(line: LineConfig) -> Callable[[Receiver], Awaitable[Port]]:
    """What opens the line's port: the real one, or its devices simulated in memory."""
    if isinstance(line.port, SimulatorAddress):
        stations = [station_for(device.driver, device.tags) for device in line.devices]
        return lambda ear: open_simulator(stations, line.wire, ear)
    return lambda ear: open_port(line.port, line.serial, ear)


def forecasts(config: Config) -> list[LineForecast]:
    """What the file will do to each line."""
    return [
        forecast(
            line.name,
            [device_of(device, line) for device in line.devices if device.enabled],
            line.wire,
        )
        for line in config.lines
    ]


class _Asker(NamedTuple):
    """Somebody who waits for a reading later than that of `asked`, by the loop's clock."""

    answer: asyncio.Future[Sample]
    asked: float


class Gateway:
    """Everything below Zenoh: the lines, and what is known of every tag."""

    def __init__(
        self,
        config: Config,
        wall: Callable[[], int] = time.time_ns,
        open_line: Callable[[LineConfig], Callable[[Receiver], Awaitable[Port]]] = opener,
    ) -> None:
        """`wall`: nanoseconds since 1970. `open_line`: what opens a line's port."""
        self.config = config
        self.lines: list[Line] = []
        self.mirror = Mirror((tag for device in config.devices for tag in device.tags), wall())
        self.publish: Callable[[Sequence[Sample]], None] = lambda samples: None
        self.show_alive: Callable[[str, bool], None] = lambda device, alive: None
        self.documents: dict[str, Callable[[], Document]] = {}  # what others add to the status
        self._wall = wall
        self._open_line = open_line
        self._started = wall()
        self._tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self._places: dict[str, tuple[Line, Device]] = {}
        self._forecasts: dict[str, LineForecast] = {}
        self._waiting: dict[Tag, list[_Asker]] = {}
        for seed, line in enumerate(config.lines):
            self._add_line(line, seed)
        for device in config.devices:
            if not device.enabled:
                self.mirror.update(bad(tag, Reason.DISABLED, wall()) for tag in device.tags)

    def _add_line(self, config: LineConfig, seed: int) -> None:
        devices = [device_of(device, config) for device in config.devices if device.enabled]
        line = Line(
            config.name,
            devices,
            config.wire,
            self._open_line(config),
            self,
            self._wall,
            echo=config.echo,
            seed=seed,
        )
        self.lines.append(line)
        self._forecasts[config.name] = forecast(config.name, devices, config.wire)
        for device in devices:
            self._places[device.name] = (line, device)

    @property
    def spoken_to(self) -> Sequence[Device]:
        """The devices that are not disabled."""
        return [device for _, device in self._places.values()]

    # What the lines tell

    def samples(self, samples: Sequence[Sample]) -> None:
        news = self.mirror.update(samples)
        if self._waiting:
            for sample in samples:
                if sample.tag in self._waiting:
                    self._answer(sample)
        if news:
            self.publish(news)

    def alive(self, device: Device, alive: bool) -> None:
        self.show_alive(device.name, alive)

    # What Zenoh asks

    def devices(self) -> Iterable[DeviceSettings]:
        return self.config.devices

    def tag(self, key: str) -> Tag | None:
        return self._tags.get(key)

    def sample(self, tag: Tag) -> Sample:
        return self.mirror[tag]

    def mark_published(self, samples: Sequence[Sample]) -> None:
        if news := self.mirror.mark_published(samples):
            self.publish(news)  # as any other: what is published is kept in history too

    async def write(self, tag: Tag, value: Value) -> WriteResult:
        """Returns when the device has acknowledged. Raises `GatewayError`, `BadValue` first."""
        if tag.device not in self._places:
            raise Offline(f"device {tag.device} is disabled; nothing was sent")
        units = tag.encode(value)
        line, device = self._places[tag.device]
        outcome: asyncio.Future[WriteResult] = asyncio.get_running_loop().create_future()
        line.submit(device, tag, units, partial(_end, outcome))
        return await outcome

    def commands(self) -> Mapping[str, frozenset[str]]:
        return every_command(self.config)

    def speaker(self, line: str) -> str:
        return speaker(self.config, line)

    async def control(self, device: str, command: str, argument: str = "") -> CommandResult:
        """Have a device run, stop ...: what it said. Raises `GatewayError`, `BadValue` first."""
        check_command(self.config, device, command)
        line, told = self._places[device]
        loop = asyncio.get_running_loop()
        started = loop.time()
        outcome: asyncio.Future[str] = loop.create_future()
        line.command(told, command, argument, partial(_end, outcome))
        answer = await outcome
        return CommandResult(answer, self._wall(), loop.time() - started)

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """Whether it was read less than `max_age` seconds ago, or cannot be read now.

        By the clock that nobody sets.
        """
        poll = self._poll(tag)
        if poll is None or not self._places[tag.device][0].is_open:
            return True
        if poll.last_good is None or self.mirror[tag].quality is Quality.BAD:
            return False
        return asyncio.get_running_loop().time() - poll.last_good < max_age

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """What is known if that `is_fresh`, or else what is read from now on; simultaneous askers
        share one exchange.

        Bad where the device does not answer. Raises `Busy` when the line did not get to it.
        """
        poll = self._poll(tag)
        if poll is None or self.is_fresh(tag, max_age):
            return self.mirror[tag]
        asker = _Asker(asyncio.get_running_loop().create_future(), poll.asked)
        self._waiting.setdefault(tag, []).append(asker)
        self._hasten(tag)
        try:
            async with asyncio.timeout(FRESH_WITHIN):
                return await asker.answer
        except TimeoutError:
            if self.mirror[tag].quality is Quality.BAD:
                return self.mirror[tag]
            raise Busy(f"{tag.key} could not be read within {FRESH_WITHIN:g} s") from None
        finally:
            self._forget(tag, asker)

    def _answer(self, sample: Sample) -> None:
        """A value whose reading had begun may be older than what made somebody ask: he waits for
        the next."""
        tag = sample.tag
        poll = self._poll(tag)
        for asker in self._waiting[tag]:
            if asker.answer.done():
                continue
            if sample.quality is Quality.BAD or poll is None or poll.asked > asker.asked:
                asker.answer.set_result(self.mirror[tag])
            else:
                self._hasten(tag)

    def _forget(self, tag: Tag, asker: _Asker) -> None:
        """Of a device that stays silent no sample comes that would."""
        self._waiting[tag].remove(asker)
        if not self._waiting[tag]:
            del self._waiting[tag]

    def _poll(self, tag: Tag) -> Poll | None:
        """What reads the tag: nothing where its value comes unasked."""
        if tag.device not in self._places:
            return None
        line, device = self._places[tag.device]
        return line.reader(device, tag)

    def _hasten(self, tag: Tag) -> None:
        line, device = self._places[tag.device]
        line.refresh(device, tag)

    def status(self) -> Mapping[str, Document]:
        """Documents by path: `status`, `lines/<line>`, `devices/<device>`."""
        now = asyncio.get_running_loop().time()
        documents: dict[str, Document] = {
            "status": {
                "name": self.config.name,
                "version": __version__,
                "time": rfc3339(self._wall()),
                "up": round((self._wall() - self._started) / 1e9, 1),
                "tags": len(self._tags),
                "lines": {line.name: line.is_open for line in self.lines},
                "devices": {name: d.standing.value for name, (_, d) in self._places.items()},
            }
        }
        for line in self.lines:
            documents[f"lines/{line.name}"] = line_document(line, self._forecasts[line.name], now)
        for name, (_, device) in self._places.items():
            polls = self._places[name][0].polls(device)
            documents[f"devices/{name}"] = device_document(device, polls)
        return documents | {path: document() for path, document in self.documents.items()}


def _end(outcome: "asyncio.Future[T]", result: T | GatewayError) -> None:
    """Tell whoever still waits."""
    if outcome.done():
        return
    if isinstance(result, GatewayError):
        outcome.set_exception(result)
    else:
        outcome.set_result(result)
