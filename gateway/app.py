"""Connects the lines of a configuration with the last sample of every tag, without Zenoh."""

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

from gateway import __version__
from gateway.alarms import Alarms
from gateway.alarms.watched import watch
from gateway.config import Config, LineConfig
from gateway.config.commands import check_command, every_command, speaker
from gateway.engine.device import Device, DeviceSettings
from gateway.engine.forecast import LineForecast, forecast
from gateway.engine.jobs import Poll
from gateway.engine.requests import WRITE_EXPIRY, CommandResult, Peeked
from gateway.errors import BadValue, Busy, ConfigError, Offline
from gateway.line.build import OpenPort, line_of, opener
from gateway.line.duty import Duty
from gateway.line.line import Line
from gateway.line.serving import Serving
from gateway.line.wire_log import WireLog
from gateway.northbound.served_status import served_documents
from gateway.northbound.status import Document, device_document, line_document, standing
from gateway.protocols.driver import Address
from gateway.protocols.ranges import addresses, spans
from gateway.serving.station import Station
from gateway.tags import Quality, Reason, Sample, Tag, WriteResult, bad
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Scan
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

MOST_PEEKED = 256  # addresses of one peek
FRESH_WITHIN = 5.0  # seconds that a client waits for a read on demand


def forecasts(
    config: Config, report: Callable[[str, float], None] | None = None
) -> list[LineForecast]:
    """Calculates the load and the worst ages of each line of the file.

    `report` receives the name of this step and the share of it that is done.
    """
    found = []
    for line in config.lines:
        if line.serve:
            continue
        devices = [Device(device, line.wire) for device in line.devices if device.enabled]
        found.append(forecast(line.name, devices, line.wire))
        if report is not None:
            report("planning the requests", len(found) / len(config.lines))
    return found


class Subscriber(Protocol):
    """Receives the samples to publish and the device states, on the event loop."""

    def publish(self, samples: Sequence[Sample]) -> None: ...

    def set_online(self, device: str, online: bool) -> None: ...


class _Reader(NamedTuple):
    """A client that waits for a read that starts after `asked`, by the line's clock."""

    answer: asyncio.Future[Sample]
    asked: float


class Gateway:
    """The lines of one configuration, and the last sample of every tag."""

    def __init__(
        self,
        config: Config,
        wall: Callable[[], int] = time.time_ns,
        open_line: Callable[[LineConfig], OpenPort] = opener,
        duty: Duty | None = None,
        *,
        plan_now: bool = True,
    ) -> None:
        """`wall`: nanoseconds since 1970. `open_line`: returns the opener of a line's port.

        Without `plan_now` each line needs `plan` and `planned` before it runs.
        """
        self.config = config
        self.duty = duty or Duty()
        self.mirror = Mirror((tag for device in config.devices for tag in device.tags), wall())
        self.lines: list[Line] = []
        self._wall = wall
        self._started = time.monotonic()  # the wall clock may be set back
        self._subscribers: list[Subscriber] = []
        self._documents: dict[str, Callable[[], Document]] = {}  # of other parts, in the status
        self._tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self._places: dict[str, tuple[Line, Device]] = {}
        self._forecasts: dict[str, LineForecast] = {}
        self._waiting: dict[Tag, list[_Reader]] = {}
        self.alarms = Alarms(self._tags.values(), wall)
        self.add_document("alarms", self.alarms.counts)
        self.serving = Serving(config, self, self._find_sample, wall=wall, duty=self.duty)
        for seed, line in enumerate(config.lines):
            self._add_line(line, open_line(line), seed)
        watch(self.alarms, self.lines, config.alarms)
        if plan_now:
            for made in self.lines:
                self.planned(made, self.plan(made))
        for device in config.devices:
            if not device.enabled:
                self.mirror.update(bad(tag, Reason.DISABLED, wall()) for tag in device.tags)

    def begin(self) -> None:
        """Stamps the first samples again: this gateway may have been in standby for months."""
        if self.config.standby is not None:
            self.mirror.begin(self._wall())

    def _add_line(self, config: LineConfig, open_port: OpenPort, seed: int) -> None:
        if config.serve:
            return
        devices = [device for device in config.devices if device.enabled]
        line = line_of(
            config,
            devices,
            self,
            open_port=open_port,
            wall=self._wall,
            seed=seed,
            duty=self.duty,
            plan_now=False,
        )
        self.lines.append(line)
        for device in line.engine.devices:
            self._places[device.name] = (line, device)

    @staticmethod
    def plan(line: Line) -> LineForecast:
        """Plans the devices of a line. A thread may do it before `planned`: it takes long."""
        engine = line.engine
        for device in engine.devices:
            device.plan()
        return forecast(engine.name, engine.devices, engine.wire)

    def planned(self, line: Line, expected: LineForecast) -> None:
        """Takes over the plans of a line: it may run now."""
        self._forecasts[line.engine.name] = expected
        for device in line.engine.devices:
            line.engine.schedule.plan(device, 0.0)

    def subscribe(self, subscriber: Subscriber) -> None:
        """Adds a subscriber. It receives each sample after the earlier subscribers."""
        self._subscribers.append(subscriber)

    def add_document(self, path: str, document: Callable[[], Document]) -> None:
        """Adds a document of another part to the status."""
        self._documents[path] = document

    def wire_logs(self) -> Mapping[str, WireLog]:
        polled = {line.engine.name: line.wire_log for line in self.lines}
        return polled | {line.name: line.wire_log for line in self.serving.lines}

    @property
    def enabled_devices(self) -> Sequence[Device]:
        return [device for _, device in self._places.values()]

    # From the lines

    def samples(self, samples: Sequence[Sample]) -> None:
        changed = self.mirror.update(samples)
        if self.alarms.of_tags and not (type(samples) is Scan and samples.latest.alarmed == ()):
            self.alarms.judge(samples)
        if self.serving.remembering:
            self.serving.remember(samples)
        if self._waiting:
            for sample in samples:
                if sample.tag in self._waiting:
                    self._answer(sample)
        if self.mirror.derives and (changed or self.mirror.pending):
            changed = self.mirror.follow(changed)
            if self.alarms.of_tags:
                self.alarms.judge([sample for sample in changed if sample.tag.inputs])
            if self.serving.remembering:
                self.serving.remember(changed)
        if changed:
            self._publish(changed)

    def online(self, device: Device | Station, online: bool) -> None:
        for subscriber in self._subscribers:
            subscriber.set_online(device.name, online)

    def _publish(self, samples: Sequence[Sample]) -> None:
        for subscriber in self._subscribers:
            subscriber.publish(samples)

    # For the Zenoh side

    def devices(self) -> Iterable[DeviceSettings]:
        return self.config.devices

    def tag(self, key: str) -> Tag | None:
        return self._tags.get(key)

    def sample(self, tag: Tag) -> Sample:
        return self.mirror[tag]

    def _find_sample(self, key: str) -> Sample | None:
        """Returns the sample of `device/tag`; None: no such tag in this process."""
        tag = self._tags.get(key)
        return None if tag is None else self.mirror[tag]

    def mark_published(self, samples: Sequence[Sample]) -> None:
        if changed := self.mirror.mark_published(samples):
            self._publish(changed)  # history keeps it too

    async def write(self, tag: Tag, value: Value, within: float = WRITE_EXPIRY) -> WriteResult:
        """Returns when the device has acknowledged.

        Raises `BadValue` before anything is sent, otherwise a `GatewayError`.
        """
        if self.serving.holds(tag):
            return await self.serving.write(tag, value)
        if tag.device not in self._places:
            raise Offline(f"device {tag.device} is disabled; nothing was sent")
        units = tag.encode(value)
        line, device = self._places[tag.device]
        return await line.write(device, tag, units, within)

    def commands(self) -> Mapping[str, frozenset[str]]:
        return every_command(self.config)

    def speaker(self, line: str) -> str:
        return speaker(self.config, line)

    async def control(
        self, device: str, command: str, argument: str = "", within: float = WRITE_EXPIRY
    ) -> CommandResult:
        """Returns the reply of the device.

        Raises `BadValue` before anything is sent, otherwise a `GatewayError`.
        """
        check_command(self.config, device, command)
        line, receiver = self._places[device]
        loop = asyncio.get_running_loop()
        started = loop.time()
        answer = await line.command(receiver, command, argument, within)
        return CommandResult(answer, self._wall(), loop.time() - started)

    async def peek(self, device: str, text: str) -> Peeked:
        """Reads any addresses once, such as `D100..D119`.

        Raises `BadValue` before anything is sent, otherwise a `GatewayError`.
        """
        if device not in self._places:
            raise Offline(f"no device {device} is polled here; nothing was sent")
        line, receiver = self._places[device]
        try:
            area, numbers = addresses(receiver.driver, text, MOST_PEEKED)
            parts = list(spans(receiver.driver, area, numbers))
        except ConfigError as error:
            raise BadValue(str(error)) from None
        loop = asyncio.get_running_loop()
        started, units = loop.time(), list[int]()
        for part in parts:
            units += map(int, (await line.peek(receiver, part)).split())
        first = receiver.driver.spell(Address(area, numbers.start))
        return Peeked(first, units, self._wall(), loop.time() - started)

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """True if the last read is younger than `max_age` seconds, or no read is possible now.

        The age is monotonic time: a change of the system clock must not change it.
        """
        if tag.inputs:
            return all(self.is_fresh(one, max_age) for one in tag.inputs)
        poll = self._poll(tag)
        if poll is None or not self._places[tag.device][0].engine.is_open:
            return True
        if poll.last.at is None or self.mirror[tag].quality is Quality.BAD:
            return False
        return asyncio.get_running_loop().time() - poll.last.at < max_age

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """Returns the last sample if it `is_fresh`, otherwise that of the next read.

        Several clients share one read. The sample is bad if the device does not answer. Raises
        `Busy` if the line had no time for the read.
        """
        if tag.inputs:
            await asyncio.gather(*(self.fresh(one, max_age) for one in tag.inputs))
            return self.mirror[tag]
        poll = self._poll(tag)
        if poll is None or self.is_fresh(tag, max_age):
            return self.mirror[tag]
        reader = _Reader(asyncio.get_running_loop().create_future(), poll.asked)
        self._waiting.setdefault(tag, []).append(reader)
        self._expedite(tag)
        try:
            async with asyncio.timeout(FRESH_WITHIN):
                return await reader.answer
        except TimeoutError:
            if self.mirror[tag].quality is Quality.BAD:  # an offline device sends no sample
                return self.mirror[tag]
            raise Busy(f"{tag.key} could not be read within {FRESH_WITHIN:g} s") from None
        finally:
            self._waiting[tag].remove(reader)
            if not self._waiting[tag]:
                del self._waiting[tag]

    def _answer(self, sample: Sample) -> None:
        """Answers waiting clients. A read that started before the request does not satisfy it."""
        tag = sample.tag
        poll = self._poll(tag)
        for reader in self._waiting[tag]:
            if reader.answer.done():
                continue
            if sample.quality is Quality.BAD or poll is None or poll.asked > reader.asked:
                reader.answer.set_result(self.mirror[tag])
            else:
                self._expedite(tag)

    def _poll(self, tag: Tag) -> Poll | None:
        """Returns the poll that reads the tag; None if the value is unsolicited."""
        if tag.device not in self._places:
            return None
        line, device = self._places[tag.device]
        return line.engine.schedule.reader(device, tag)

    def _expedite(self, tag: Tag) -> None:
        line, device = self._places[tag.device]
        line.expedite(device, tag)

    def status(self) -> Mapping[str, Document]:
        """Returns documents by path: `status`, `lines/<line>`, `devices/<device>`."""
        now = asyncio.get_running_loop().time()
        documents: dict[str, Document] = {
            "status": {
                "name": self.config.name,
                "version": __version__,
                "time": rfc3339(self._wall()),
                "up": round(time.monotonic() - self._started, 1),
                "tags": len(self._tags),
                "lines": {line.engine.name: line.engine.is_open for line in self.lines}
                | {line.name: line.is_open for line in self.serving.lines},
                "devices": {name: standing(d) for name, (_, d) in self._places.items()}
                | {station.name: station.presence.value for station in self.serving.stations},
            }
        }
        for line in self.lines:
            engine = line.engine
            if (expected := self._forecasts.get(engine.name)) is None:
                continue  # not planned yet
            documents[f"lines/{engine.name}"] = line_document(engine, expected, now)
        for name, (line, device) in self._places.items():
            polls = line.engine.schedule.polls(device)
            documents[f"devices/{name}"] = device_document(device, polls, now)
        documents |= served_documents(self.serving.lines, now)
        return documents | {path: document() for path, document in self._documents.items()}
