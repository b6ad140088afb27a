"""A plant of plain data, and a gateway that serves it on Zenoh."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

from gateway.config import ZenohConfig
from gateway.contract.interfaces import History
from gateway.engine.jobs.requests import CommandResult, Peeked
from gateway.errors import BadValue, Busy, GatewayError, NotSent
from gateway.line.send_permit import SendPermit
from gateway.line.wire_log import WireLog
from gateway.northbound.northbound import Northbound
from gateway.parts.alarms.part import AlarmPart
from gateway.parts.alarms.settings import AlarmsSection
from gateway.plant.doors import Doors
from gateway.plant.part import Core
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Reason, Sample, Tag, WriteResult, WriteRule, bad, good
from gateway.values import Layout, Value, parse_type
from tests.no_parts import STATUS
from tests.tag_settings import grouped
from tests.zenoh_peer import TIMEOUT, ZenohPeer, free_endpoint


def tag(device: str, name: str, **settings: Any) -> Tag:
    return Tag(
        device=device,
        name=name,
        text="D100",
        address=Address("D", 100),
        span=Span("D", 100, 1),
        unit_kind=Unit.WORD,
        layout=Layout(parse_type("int16")),
        **grouped(**settings),
    )


@dataclass(frozen=True)
class PlainDevice:
    name: str
    tags: tuple[Tag, ...]
    blocks: bool | Literal["only"] = False
    control: bool = False
    templates: tuple[str, ...] = ()


class PlainPlant:
    """Samples in a dict. A write is acknowledged, or ends as `endings` says for its value. A
    command ends with `command_result`."""

    def __init__(self, *devices: PlainDevice) -> None:
        self.duty = SendPermit()
        self._devices = devices
        self._tags = {tag.key: tag for device in devices for tag in device.tags}
        self.doors, self.lines = Doors(), ()
        self.parts = PlainParts(self)
        self.alarms = self.parts.alarms.alarms
        self.samples = {
            key: bad(tag, Reason.STARTING, time.time_ns()) for key, tag in self._tags.items()
        }
        self.endings: dict[Value, Exception] = {}
        self.gate = asyncio.Event()  # writes wait for it
        self.gate.set()
        self.written: list[tuple[str, Value]] = []
        self.read: list[str] = []
        self.dial = 0.0  # seconds, of a telephone call
        self.within = 0.0  # of the last write
        self.unread: set[str] = set()  # tags that the line does not read in time
        self.republished: list[Sample] = []
        self.known_commands: Mapping[str, frozenset[str]] = {}
        self.command_result: CommandResult | Exception = CommandResult("acknowledged", 1, 0.1)
        self.commanded: list[tuple[str, str, str]] = []
        self.hall = WireLog()

    def tags(self) -> Iterable[Tag]:
        return self._tags.values()

    def wall(self) -> int:
        return time.time_ns()

    @property
    def config(self) -> Any:
        zenoh = ZenohConfig(prefix="works")
        return SimpleNamespace(part=lambda _kind: AlarmsSection(), zenoh=zenoh)

    def wire_logs(self) -> Mapping[str, WireLog]:
        return {"hall": self.hall}

    def devices(self) -> Iterable[PlainDevice]:
        return self._devices

    def begin(self) -> None:
        pass

    def tag(self, key: str) -> Tag | None:
        return self._tags.get(key)

    def sample(self, tag: Tag) -> Sample:
        return self.samples[tag.key]

    async def write(self, tag: Tag, value: Value, within: float) -> WriteResult:
        tag.encode(value)
        self.within = within
        await self.gate.wait()
        if value in self.endings:
            raise self.endings[value]
        self.written.append((tag.key, value))
        return WriteResult(value, time.time_ns(), verified=True, took=0.031)

    async def write_group(
        self, values: Sequence[tuple[Tag, Value]], within: float, patience: float
    ) -> Sequence[WriteResult | GatewayError]:
        ends = list[WriteResult | GatewayError]()
        for tag, value in values:
            if any(isinstance(end, GatewayError) for end in ends):
                ends.append(NotSent("not sent, because one before it failed"))
                continue
            try:
                ends.append(await self.write(tag, value, within))
            except GatewayError as error:
                ends.append(error)
        return ends

    def mark_published(self, samples: Sequence[Sample]) -> None:
        self.republished += samples

    def commands(self) -> Mapping[str, frozenset[str]]:
        return self.known_commands

    def speaker(self, line: str) -> str:
        if line != "hall":
            raise BadValue(f"there is no line {line}")
        return "oven"

    async def control(
        self, device: str, command: str, argument: str, within: float
    ) -> CommandResult:
        self.commanded.append((device, command, argument))
        if isinstance(self.command_result, Exception):
            raise self.command_result
        return self.command_result

    async def peek(self, device: str, text: str) -> Peeked:
        raise BadValue(f"{device} has no {text}")

    def dialling(self, device: str) -> float:
        return self.dial

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        return time.time_ns() - self.samples[tag.key].time < max_age * 1e9

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        if not self.is_fresh(tag, max_age):
            self.read.append(tag.key)
            if tag.key in self.unread:
                raise Busy(f"{tag.key} could not be read")
            self.samples[tag.key] = good(tag, 4711, time.time_ns())
        return self.samples[tag.key]

    def status(self) -> Mapping[str, Mapping[str, object]]:
        return {"status": STATUS, "loads/hall-1": {"load": 0.5}}

    def now(self, key: str, value: Value) -> Sample:
        """A new sample, already current."""
        self.samples[key] = good(self._tags[key], value, time.time_ns())
        return self.samples[key]


class PlainParts:
    """The alarms of a plant, and perhaps a history. They never fail."""

    def __init__(self, plant: PlainPlant, history: History | None = None) -> None:
        self.kept = history
        self.north: Northbound | None = None
        doubles: Any = plant, self  # of the plant and of Zenoh
        self.alarms = AlarmPart(Core(doubles[0], doubles[1], self.history, self))

    def has_keys(self, part: str) -> bool:
        return part == "alarms"

    def keyed(self, part: str) -> AlarmPart:
        return self.alarms

    def history(self) -> History | None:
        return self.kept

    def each(self, capability: type[Any]) -> Sequence[Any]:
        return [self.alarms] if isinstance(self.alarms, capability) else []

    def audit(self, at: int, event: str) -> None:
        """There is none."""

    async def publish_all(self) -> None:
        await self.alarms.publish_all()

    def publish_latest(self, path: str, make: Callable[[], bytes]) -> None:
        if self.north is not None:
            self.north.publish_latest(path, make)
        else:
            make()


async def nothing() -> None:
    """The parts have nothing to publish again."""


def northbound_of(plant: PlainPlant, settings: ZenohConfig, **others: Any) -> Northbound:
    """`others`: those of `Northbound`, `name` and `history`."""
    plant.parts.kept, name = others.pop("history", None), others.pop("name", "demo")
    made = plant.parts.north = Northbound(settings, name, plant, parts=plant.parts, **others)
    return made


def mixer(*, blocks: bool | Literal["only"] = False) -> PlainPlant:
    return PlainPlant(
        PlainDevice(
            "mixer",
            (
                tag("mixer", "speed", unit="rpm"),
                tag("mixer", "alarms/door", description="Guard door open"),
                tag("mixer", "recipe", write=WriteRule(min=1, max=4000)),
            ),
            blocks,
        ),
        PlainDevice("oven", (tag("oven", "temperature"),)),
    )


@asynccontextmanager
async def serving(plant: PlainPlant, settings: ZenohConfig) -> AsyncIterator[Northbound]:
    async with running(northbound_of(plant, settings, status_every=0.5)) as northbound:
        yield northbound


@asynccontextmanager
async def running(northbound: Northbound) -> AsyncIterator[Northbound]:
    """Runs it until everything is declared, or until it fails; stops it at the end."""
    serves = asyncio.create_task(northbound.run())
    opens = asyncio.create_task(northbound.opened.wait())
    await asyncio.wait([serves, opens], return_when=asyncio.FIRST_COMPLETED, timeout=TIMEOUT)
    try:
        if serves.done():
            serves.result()
        yield northbound
    finally:
        opens.cancel()
        serves.cancel()
        await asyncio.wait([serves], timeout=TIMEOUT)
        assert serves.done()


@asynccontextmanager
async def gateway_and_client(
    plant: PlainPlant,
) -> AsyncIterator[tuple[Northbound, ZenohPeer]]:
    """A gateway that listens, and a client in another process."""
    endpoint = free_endpoint()
    async with (
        serving(plant, ZenohConfig(listen=(endpoint,))) as northbound,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        yield northbound, client


def has_value(key: str, value: Value | None) -> Any:
    return lambda sample: sample.key == key and sample.json["value"] == value


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(300):
        while not condition():
            await asyncio.sleep(0.005)
