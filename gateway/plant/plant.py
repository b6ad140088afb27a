"""The lines of a configuration, the last sample of every tag, and the doors for the parts."""

import asyncio
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol, get_args

from gateway import __version__
from gateway.config import Config, LineConfig
from gateway.config.changes import DeviceChange
from gateway.config.commands import check_command, every_command, speaker
from gateway.contract.faults import below
from gateway.contract.keys import CONTRACT
from gateway.contract.status import Document, device_document, line_document
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.forecast import LineForecast, forecast
from gateway.engine.jobs.requests import WRITE_EXPIRY, CommandResult, Peeked
from gateway.errors import GatewayError
from gateway.line.line import Line
from gateway.line.opening import OpenPort
from gateway.line.send_permit import SendPermit
from gateway.line.wire_log import WireLog
from gateway.plant.any_address import AnyAddress
from gateway.plant.build import line_of, opener
from gateway.plant.doors import Doors
from gateway.plant.expected import Adjust, Expected
from gateway.plant.on_demand import OnDemand
from gateway.plant.write_path import WritePath
from gateway.tags import Reason, Sample, Tag, WriteResult, bad
from gateway.tags.mirror import Mirror
from gateway.tags.tag import NotReal
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

REMOVED = "removed from the file"


class Named(Protocol):
    """A device, or a station of the gateway."""

    @property
    def name(self) -> str: ...


class Subscriber(Protocol):
    """Receives the samples to publish and the device states, on the event loop."""

    def publish(self, samples: Sequence[Sample]) -> None: ...

    def set_online(self, device: str, online: bool) -> None: ...


class Plant:
    """The lines of one configuration, and the last sample of every tag.

    Parts use `subscribe`, `adjust_forecasts` and the `doors`.
    """

    def __init__(
        self,
        config: Config,
        wall: Callable[[], int] = time.time_ns,
        open_line: Callable[[LineConfig], OpenPort] = opener,
        duty: SendPermit | None = None,
        *,
        plan_now: bool = True,
    ) -> None:
        """`wall`: nanoseconds since 1970. `open_line`: returns the opener of a line's port.

        Without `plan_now` each line needs `plan` and `planned` before it runs.
        """
        self.config = config
        self.duty = duty or SendPermit()
        self.mirror = Mirror((tag for device in config.devices for tag in device.tags), wall())
        self.lines: list[Line] = []
        self._wall = wall
        self._started = time.monotonic()  # the wall clock may be set back
        self._subscribers: list[Subscriber] = []
        self.doors = Doors()
        self._tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self._places: dict[str, tuple[Line, Device]] = {}
        self._open_line, self._seeds = open_line, itertools.count()
        self._expected = Expected(lambda: self.config)
        self._on_demand = OnDemand(self._places.get, self.sample)
        any_address = AnyAddress(self._places, wall)
        self._requests = WritePath(self._places, self._tags, any_address, self.doors.stores, wall)
        for line in config.lines:
            if not line.serve:
                self.add_line(line)
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

    def add_line(self, config: LineConfig) -> Line:
        """Makes a line, which needs `plan` and `planned` before it runs."""
        line = line_of(
            config,
            [device for device in config.devices if device.enabled],
            self,
            open_port=self._open_line(config),
            wall=self._wall,
            seed=next(self._seeds),
            duty=self.duty,
            plan_now=False,
        )
        self.lines.append(line)
        for device in line.engine.devices:
            self._places[device.name] = (line, device)
        return line

    def remove_line(self, line: Line) -> None:
        """Removes a line that has ended, and has no devices any more."""
        self.lines.remove(line)
        self._expected.drop(line.engine.name)

    @staticmethod
    def plan(line: Line) -> LineForecast:
        """Plans the devices of a line. A thread may do it before `planned`: it takes long."""
        engine = line.engine
        for device in engine.devices:
            device.plan()
        return forecast(engine.name, engine.devices, engine.wire)

    def planned(self, line: Line, expected: LineForecast) -> None:
        """Takes over the plans of a line: it may run now."""
        self.expect(expected)
        line.engine.planned(0.0)

    def expect(self, line: LineForecast) -> None:
        """Takes over the forecast of a line."""
        self._expected.take(line)

    def take_over(self, changes: Iterable[DeviceChange]) -> None:
        """Takes over the tags of changed devices: their first, next or last samples."""
        now, gone = self._wall(), list[Tag]()
        for change in changes:
            enabled = change.new is not None and change.new.enabled
            reason = Reason.STARTING if enabled else Reason.DISABLED
            started = [bad(tag, reason, now) for tag in change.started]
            self.mirror.add(started, change.renewed)
            if change.new is not None:
                self._tags.update((tag.key, tag) for tag in change.new.wire_tags)
            left = change.gone
            ended = [tag for tag in left if self._tags[tag.key] is tag]
            for tag in ended:
                del self._tags[tag.key]
            self.mirror.forget(left)  # last: other threads find the new tag instead
            self.doors.retagged([*change.started, *change.renewed.values()], left)
            self._see(started)
            last = [bad(tag, Reason.DISABLED, now, REMOVED) for tag in ended]
            self._publish([*started, *last])
            gone += left
        self._on_demand.changed(gone)

    def compute(self, new: Sequence[Tag], gone: Sequence[Tag]) -> None:
        """Takes over the computed tags, when all their inputs are taken over."""
        if not (gone or new):
            return
        now = self._wall()
        enabled = {device.name for device in self.config.devices if device.enabled}
        self._tags.update((tag.key, tag) for tag in new)
        first = [
            bad(tag, Reason.STARTING if tag.device in enabled else Reason.DISABLED, now)
            for tag in new
        ]
        self.doors.retagged(new, gone)
        found = self.mirror.compute(first, gone)
        self._see(found)
        ended = [tag for tag in gone if self._tags.get(tag.key) is tag]
        for tag in ended:
            del self._tags[tag.key]
        self._publish([*found, *(bad(tag, Reason.DISABLED, now, REMOVED) for tag in ended)])

    def configure(self, config: Config) -> None:
        """Has this configuration, after its changes are taken over."""
        self.config = config

    def move(self, gone: Iterable[str], line: Line, devices: Iterable[Device] = ()) -> None:
        """Notes the devices that the line has no longer, and those that it has now."""
        for name in gone:
            self._places.pop(name, None)
        self._places |= {device.name: (line, device) for device in devices}

    def subscribe(self, subscriber: Subscriber) -> None:
        """Adds a subscriber. It receives each sample after the earlier subscribers."""
        self._subscribers.append(subscriber)

    def forecasts(self, config: Config) -> Sequence[LineForecast]:
        """Returns the forecasts of the lines of another file. A thread may do it."""
        return self._expected.of(config)

    def adjust_forecasts(self, adjust: Adjust) -> None:
        """Has the forecasts adjusted for the requests of a part."""
        self._expected.adjust(adjust)

    def wire_logs(self) -> Mapping[str, WireLog]:
        polled = {line.engine.name: line.wire_log for line in self.lines}
        return {name: log for logs in self.doors.logs for name, log in logs().items()} | polled

    @property
    def enabled_devices(self) -> Sequence[Device]:
        return [device for _, device in self._places.values()]

    # From the lines

    def samples(self, samples: Sequence[Sample]) -> None:
        changed = self.mirror.update(samples)
        for seen in self.doors.seers:
            seen(samples)
        if self._on_demand.arrived:
            self._on_demand.note(samples)
        if self._on_demand.waiting:
            self._on_demand.answer_all(samples)
        if self.mirror.derives and (changed or self.mirror.pending):
            changed = self.mirror.follow(changed)
            self._see([sample for sample in changed if sample.tag.origin.inputs])
        if changed:
            self._publish(changed)

    def _see(self, samples: Sequence[Sample]) -> None:
        for seen in self.doors.seers if samples else ():
            seen(samples)

    def online(self, device: Named, online: bool) -> None:
        for subscriber in self._subscribers:
            subscriber.set_online(device.name, online)

    def _publish(self, samples: Sequence[Sample]) -> None:
        for subscriber in self._subscribers:
            subscriber.publish(samples)

    # For the Zenoh side

    def devices(self) -> Iterable[DeviceSettings]:
        return self.config.devices  # the same object until a reload

    def tag(self, key: str) -> Tag | None:
        return self._tags.get(key)

    def target(self, key: str) -> Tag | None:
        """Finds a tag that a transfer writes: also one that no client sees."""
        others = (tag for device in self.config.devices for tag in device.targets)
        return self._tags.get(key) or next((tag for tag in others if tag.key == key), None)

    def sample(self, tag: Tag) -> Sample:
        try:
            return self.mirror[tag]
        except KeyError:  # a reload removed it, or another tag has its place
            current = self._tags.get(tag.key)
            if current is None:
                return bad(tag, Reason.DISABLED, self._wall(), REMOVED)
            return self.mirror[current]

    def holds(self, tag: Tag) -> bool:
        """Returns True for a value that clients write and a master reads."""
        return any(store.holds(tag) for store in self.doors.stores)

    def tags(self) -> Iterable[Tag]:
        return self._tags.values()

    def wall(self) -> int:
        """Returns ns since 1970."""
        return self._wall()

    def mark_published(self, samples: Sequence[Sample]) -> None:
        if changed := self.mirror.mark_published(samples):
            self._publish(changed)  # history keeps it too

    async def write_group(
        self,
        values: Sequence[tuple[Tag, Value]],
        within: float = WRITE_EXPIRY,
        patience: float = WRITE_EXPIRY,
    ) -> Sequence[WriteResult | GatewayError]:
        return await self._requests.write_group(values, within, patience)

    async def control(
        self, device: str, command: str, argument: str = "", within: float = WRITE_EXPIRY
    ) -> CommandResult:
        check_command(self.config, device, command)
        return await self._requests.control(device, command, argument, within)

    async def peek(self, device: str, text: str) -> Peeked:
        return await self.any_address.peek(device, text)

    @property
    def any_address(self) -> AnyAddress:
        """Reads and writes what no tag names."""
        return self._requests.any_address

    def dialling(self, device: str) -> float:
        return self._requests.dialling(device)

    def commands(self) -> Mapping[str, frozenset[str]]:
        return every_command(self.config)

    def speaker(self, line: str) -> str:
        return speaker(self.config, line)

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """True if the last read is younger than `max_age` seconds, or no read is possible now."""
        return self._on_demand.is_fresh(tag, max_age)

    def age(self, tag: Tag) -> float:
        """Returns the seconds since the last good read; infinite if there was none."""
        return self._on_demand.age(tag)

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """Returns the last sample if it `is_fresh`, otherwise that of the next read. Raises
        `Busy`."""
        return await self._on_demand.fresh(tag, max_age)

    def status(self) -> Mapping[str, Document]:
        """Returns documents by path: `status`, `lines/<line>`, `devices/<device>`."""
        now = asyncio.get_running_loop().time()
        documents: dict[str, Document] = {
            "status": {
                "contract": CONTRACT,
                "name": self.config.name,
                "version": __version__,
                "time": rfc3339(self._wall()),
                "up": round(time.monotonic() - self._started, 1),
                "tags": len(self._tags),
                **{
                    word: [line.name for line in self.config.lines if line.not_real == word]
                    for word in get_args(NotReal)
                },
            }
        }
        forecasts = self._expected.lines()
        for line in self.lines:
            engine = line.engine
            if (expected := forecasts.get(engine.name)) is None:
                continue  # not planned yet
            documents[f"lines/{engine.name}"] = line_document(engine, expected, line.calls, now)
        for name, (line, device) in self._places.items():
            polls = line.engine.polls(device)
            documents[f"devices/{name}"] = device_document(device, polls, now)
        for found in self.doors.documents:
            documents |= found()
        lines = {name: one["open"] for name, one in below("lines/", documents)}
        lines = {one.engine.name: one.engine.is_open for one in self.lines} | lines
        standings = {name: one["standing"] for name, one in below("devices/", documents)}
        documents["status"] = {**documents["status"], "lines": lines, "devices": standings}
        return documents
