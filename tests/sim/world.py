"""A whole gateway on virtual time with faults; every report is compared with the simulated plant.

    broken = run(seed, hours=4).broken

One seed gives one run, byte for byte: `run(seed).trace` is the hash of all that happened.
"""

import asyncio
import hashlib
import logging
import random
import tempfile
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import structlog

from gateway.config import LineConfig, load
from gateway.engine.device.changes import Changes
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.results.shorter_silences import Pace, ShorterSilences
from gateway.plant.plant import Plant
from gateway.protocols.frames import FrameDriver
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Sample
from gateway.transport import Receiver, TcpAddress
from tests.sim.bus import Bus
from tests.sim.clients import Client
from tests.sim.draw import Drawn, draw
from tests.sim.episodes import CALM
from tests.sim.expect import Expectations
from tests.sim.faults import Faults
from tests.sim.freezer import Ear, Freezer
from tests.sim.gadgets import Gadget
from tests.sim.groups import write_group
from tests.sim.judge import Judge
from tests.sim.manners import Manners
from tests.sim.net import SimNet
from tests.sim.noise import Format
from tests.sim.parties import Parties
from tests.sim.requests import ALL, protocol_of, station_in
from tests.sim.speaker import speak_now_and_then
from tests.sim.stations import Troubled, set_going, station_of
from tests.sim.story import Story
from tests.sim.transfers import Carrier
from tests.sim.virtual import run_virtual
from tests.sim.wire import SimWire

SECOND = 1_000_000_000
COARSE = 16  # bits: where each block is read twice, values change every 65.5 s


class World:
    """Gateway, stations, faults, clients and judge."""

    def __init__(self, drawn: Drawn, story: Story, seconds: float, traced: bool) -> None:
        self.drawn, self.story, self.seconds = drawn, story, seconds
        self.stations: dict[str, Troubled] = {}  # by device
        self._lines: dict[str, Bus] = {}
        self._wall_offset = 0.0
        self._trace = hashlib.sha256()
        self.note = self._note if traced else _nothing
        self._loop = asyncio.get_running_loop()
        self._began = self._loop.time()
        self.freezer = Freezer()
        if any(episode.kind == "frozen" for episode in drawn.episodes):
            self.freezer.install()
        with tempfile.TemporaryDirectory() as folder:
            config = load(drawn.write(Path(folder)))
        self.gateway = gateway = Plant(config, self._wall, self._opener)
        gateway.subscribe(self)
        for line, settings in zip(gateway.lines, config.lines, strict=True):
            self._lines[line.engine.name].line = line
            self._lines[line.engine.name].config = settings
        self._learn_soon()
        self.devices = {d.name: d for line in gateway.lines for d in line.engine.devices}
        self._settings = {d.name: d for line in config.lines for d in line.devices}
        self._buses = {d.name: self._lines[s.name] for s in config.lines for d in s.devices}
        self.judge = Judge(gateway, self._buses, self.stations, story, self._began)
        most = 400 + 8 * len(self.judge.known) + 4 * len(drawn.episodes)
        self.carrier = Carrier(self.judge, self._buses, self.devices)
        self.expect = Expectations(self.judge, self._lines, seconds, most)
        tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self.faults = Faults(
            *(drawn, self._lines, self.devices, tags),
            *(self.judge, self.expect, self._parties()),
            *(self._jump, self.note),
        )

    def _parties(self) -> Parties:
        return Parties(self.story.seed, self._lines, self.stations, self._twin, self.freezer)

    def _wall(self) -> int:
        return 1_700_000_000 * SECOND + int((self._loop.time() + self._wall_offset) * SECOND)

    def _jump(self, by: float) -> None:
        self._wall_offset += by

    def _note(self, *what: object) -> None:
        self._trace.update(repr((self._loop.time(), *what)).encode())

    def publish(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self.note("sample", sample.tag.key, sample.value, sample.quality.value, sample.time)
        self.judge.published(samples)

    def set_online(self, device: str, online: bool) -> None:
        self.note("online", device, online)
        self.judge.set_online(device, online)

    def _broke(self, what: str) -> None:
        self.judge.broke(what)  # the judge is built last

    # Building

    def _opener(self, config: LineConfig) -> Callable[[Receiver], Any]:
        chance = random.Random(f"wire {self.story.seed} {config.name}")
        stations = {
            device.name: self._station(device, config, chance)
            for device in config.devices
            if device.driver.station != 0 or isinstance(device.driver, FrameDriver)
        }
        for station in stations.values():
            station.others = [other for other in stations.values() if other is not station]
        bus = self._lines[config.name] = Bus(
            config,
            stations,
            config.devices[0].driver.protocol,
            [e for e in self.drawn.episodes if e.line == config.name],
            self.story,
            self.note,
            self._broke,
            self._loop.time,
            self._began,
        )
        by_number = {station.number: station for station in stations.values()}
        if isinstance(config.port, TcpAddress):
            bus.wire = SimNet(by_number, chance, bus, bool(self.drawn.chunks[config.name]))
            bus.wire.bridge = self.drawn.bridges.get(config.name, 0.0)
            for station in stations.values():
                station.numbered, station.ordered = True, chance.random() < 0.5
        else:
            bus.wire = self._wire(config, bus, by_number, chance)

        async def open_port(ear: Receiver) -> SimWire | SimNet:
            return await bus.wire.open(Ear(self.freezer, ear))

        return open_port

    def _wire(
        self,
        config: LineConfig,
        bus: Bus,
        by_number: dict[int, Troubled],
        chance: random.Random,
    ) -> SimWire:
        data_bits, parity, stop = tuple(config.serial.format)
        shape = Format(int(data_bits), parity != "N", int(stop), self.drawn.zeros[config.name])
        stations = list(by_number.values())

        def addressed(data: bytes) -> Sequence[Troubled]:
            protocol = protocol_of(bus.protocol, data)
            number = station_in(protocol, data)
            return stations if number == ALL.get(protocol) else [by_number[number]]

        return SimWire(
            *(config.wire, shape, stations, chance, bus, bool(config.echo)),
            chunk=self.drawn.chunks[config.name],
            addressed=None if bus.protocol in ("vigor", "frames") else addressed,
        )

    def _station(self, device: DeviceSettings, line: LineConfig, chance: random.Random) -> Troubled:
        words = [tag.span.area for tag in device.tags if tag.name == "scaled"]
        missing = {(words[0], n) for n in self.drawn.missing.get(device.name, ())}
        inner = station_of(device.driver, device.name)
        number = ord(inner.letter) if isinstance(inner, Gadget) else device.driver.station
        station = Troubled(
            *(number, inner, random.Random(chance.random()), line.wire.character),
            coarse=COARSE if device.verify_reads > 1 else 0,
            missing=missing,
        )
        station.protocol = device.driver.protocol
        station.manners = self.drawn.manners.get(device.name, Manners())
        station.turnaround = chance.choice((0.001, 0.005, 0.02, 0.05))
        station.other = random.Random(f"other {self.story.seed} {device.name}")
        self._needs_silence(station, device, line)
        told = [tag for d in line.devices if d.driver.station == 0 for tag in d.tags]
        set_going(station, device.tags, device.driver.areas, told)
        self.stations[device.name] = station
        return station

    def _needs_silence(self, station: Troubled, device: DeviceSettings, line: LineConfig) -> None:
        """Lets the station need a part of the silence that is safe for it, or for all."""
        chance = random.Random(f"silence {self.story.seed} {device.name}")
        safe = line.wire.silence(device.timing)
        least = min(line.wire.silence(one.timing) for one in line.devices)
        if chance.random() < 0.3:
            station.listens_after = safe * chance.uniform(0.0, 0.98)
        if chance.random() < 0.3:
            station.drives_for = least * chance.uniform(0.0, 0.98)

    def _learn_soon(self) -> None:
        """Lets most lines try shorter silences although they have time, and after few replies."""
        chance = random.Random(f"silence {self.story.seed}")
        for line in self.gateway.lines:
            for shorter in line.engine.rules.all:
                if not isinstance(shorter, ShorterSilences):
                    continue
                usual = shorter.pace  # no setting of the file
                shorter.pace = Pace(
                    chance.choice((0.0, 0.0, usual.needed)),
                    chance.choice((3, 10, usual.proof)),
                    chance.choice((1.0, 10.0, usual.pause)),
                )
                shorter.look_at = min(shorter.look_at, shorter.pace.proof)

    def _twin(self, name: str) -> Troubled:
        """Makes a second PLC with the number of this device, and other values."""
        device, first = self._settings[name], self.stations[name]
        chance = random.Random(f"twin {self.story.seed} {name}")
        inner = station_of(device.driver, device.name)
        twin = Troubled(first.number + 1000, inner, chance, first.character)
        twin.turnaround = first.turnaround + chance.choice((0.0, 0.002, 0.02, 0.1, 0.3))
        twin.missing = set(first.missing)
        twin.manners = first.manners
        set_going(twin, device.tags, device.driver.areas)
        return twin

    # The run

    def _tasks(self) -> list[asyncio.Task[None]]:
        """Starts all but the lines: clients, and devices that send by themselves."""
        tasks = []
        haste = {"lean": 10.0, "groups": 3.0}.get(self.story.pace, 1.0)
        for device in self.devices.values():
            bus = self._buses[device.name]
            for who in ("writer", "reader", "boss"):
                chance = random.Random(f"{who} {self.story.seed} {device.name}")
                person = Client(device, self.judge, bus, chance, haste)
                if self.story.pace == "groups":
                    groups = random.Random(f"groups {self.story.seed} {device.name}")
                    person.groups = partial(write_group, groups)
                if who == "writer":
                    tasks.append(self._start(person.write_now_and_then()))
                elif who == "reader":
                    tasks.append(self._start(person.ask_now_and_then()))
                elif device.settings.control and device.driver.protocol == "computer-link":
                    tasks.append(self._start(person.command_now_and_then()))
            if isinstance(device.driver, FrameDriver) and device.driver.sends_unsolicited:
                chance = random.Random(f"speaker {self.story.seed} {device.name}")
                station = self.stations[device.name]
                weight = next(tag for tag in device.tags if tag.span.area == LISTENED)
                every = self.expect.every(bus, device, weight)
                speaking = speak_now_and_then(device.name, station, every, bus, self.judge, chance)
                tasks.append(asyncio.create_task(speaking))
        return tasks

    async def _reload_now_and_then(self) -> None:
        """Changes one device of the file at a time: no value and no write may be wrong for that."""
        chance = random.Random(f"reload {self.story.seed}")
        pause = chance.choice((10.0, 60.0, 600.0))
        while self.devices:
            await asyncio.sleep(chance.expovariate(1 / pause))
            name = chance.choice(sorted(self.devices))
            old, line = self.devices[name], self._buses[name].line
            guard = self._settings[name].late_guard * chance.choice((1.0, 1.1))
            settings = replace(old.settings, late_guard=guard)
            new = old.successor(settings, old.bad_addresses.known())
            new.plan()
            applied = partial(self.gateway.move, (), line, [new])
            await line.change(Changes(replaced=[(old, new)]), (), applied)
            self.devices[name] = new
            self.note("reload", name)
            self.story.counts["reloads"] += 1

    def _start(self, client: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Starts a client: it stands still together with the gateway."""
        return asyncio.create_task(client, context=self.freezer.inside())

    async def live(self) -> None:
        lines = [
            asyncio.create_task(line.run(), name=line.engine.name, context=self.freezer.inside())
            for line in self.gateway.lines
        ]
        others = [*self._tasks(), self._start(self._reload_now_and_then())]
        others.append(asyncio.create_task(self.expect.look_around()))
        others.append(asyncio.create_task(self.carrier.look_around()))
        self.freezer.inside().run(self.carrier.transfers.start)
        suffering = asyncio.create_task(self.faults.suffer())
        done, _ = await asyncio.wait(
            lines + others, timeout=self.seconds, return_when=asyncio.FIRST_EXCEPTION
        )
        for task in done:
            if task in lines or task.exception() is not None:
                self.judge.broke(f"{task.get_name()} ended by itself: {task.exception()!r}")
        if suffering.done() and suffering.exception() is not None:
            self.judge.broke(f"faults ended by themselves: {suffering.exception()!r}")
        self.expect.at_the_end()
        if self.seconds > 2 * CALM:
            self.carrier.at_the_end()
        await self.carrier.transfers.stop()
        for task in (everything := [*lines, *others, suffering]):
            task.cancel()
        await asyncio.gather(*everything, return_exceptions=True)
        for bus in self._lines.values():
            if bus.wire.opened != bus.wire.closed:
                self.judge.broke(
                    f"{bus.config.name}: opened {bus.wire.opened} times, closed {bus.wire.closed}"
                )
        self.story.trace = self._trace.hexdigest()


def _nothing(*_: object) -> None:
    """Notes nothing."""


def run(
    seed: int, hours: float, pace: str = "busy", only: Sequence[str] = (), *, traced: bool = True
) -> Story:
    """Runs one seed, from drawing its plant to the last check.

    `only`: the kinds of faults that happen, to find the one that breaks a rule, also `manners`
    and `bridge`; empty: all. `traced`: the story has the hash of all events.
    """
    story = Story(seed, hours, pace, tuple(only))
    seconds = hours * 3600
    drawn = draw(seed, seconds, pace)
    if only:
        kept = tuple(episode for episode in drawn.episodes if episode.kind in only)
        manners = drawn.manners if "manners" in only else {}
        bridges = drawn.bridges if "bridge" in only else {}
        drawn = replace(drawn, episodes=kept, manners=manners, bridges=bridges)

    async def whole() -> None:
        await World(drawn, story, seconds, traced).live()

    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        run_virtual(whole())
    except Exception as error:  # noqa: BLE001 - whatever it was, the seed is worth knowing
        story.broken.append(f"the run itself ended: {error!r}")
    finally:
        structlog.configure(**before)
    return story
