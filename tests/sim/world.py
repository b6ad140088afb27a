"""A whole gateway on virtual time with faults; every report is compared with the simulated plant.

    broken = run(seed, hours=4).broken

One seed gives one run, byte for byte: `run(seed).trace` is the hash of all that happened.
"""

import asyncio
import hashlib
import logging
import random
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import structlog

from gateway.app import Gateway
from gateway.config import LineConfig, load
from gateway.engine.device import DeviceSettings
from gateway.protocols.frames import FrameDriver
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Sample
from gateway.transport import Receiver, TcpAddress
from tests.sim.bus import Bus
from tests.sim.clients import Client
from tests.sim.draw import Drawn, draw
from tests.sim.expect import Expectations
from tests.sim.faults import Faults
from tests.sim.gadgets import Gadget
from tests.sim.judge import Judge
from tests.sim.net import SimNet
from tests.sim.noise import Format
from tests.sim.parties import Parties
from tests.sim.requests import ALL, protocol_of, station_in
from tests.sim.stations import Troubled, set_going, station_of
from tests.sim.story import Story
from tests.sim.virtual import run_virtual
from tests.sim.wire import SimWire

SECOND = 1_000_000_000
COARSE = 16  # bits: where each block is read twice, values change every 65.5 s


class World:
    """Gateway, stations, faults, clients and judge."""

    def __init__(self, drawn: Drawn, story: Story, seconds: float) -> None:
        self.drawn, self.story, self.seconds = drawn, story, seconds
        self.stations: dict[str, Troubled] = {}  # by device
        self._lines: dict[str, Bus] = {}
        self._wall_offset = 0.0
        self._trace = hashlib.sha256()
        self._loop = asyncio.get_running_loop()
        self._began = self._loop.time()
        with tempfile.TemporaryDirectory() as folder:
            config = load(drawn.write(Path(folder)))
        self.gateway = gateway = Gateway(config, self._wall, self._opener)
        gateway.subscribe(self)
        for line, settings in zip(gateway.lines, config.lines, strict=True):
            self._lines[line.engine.name].line = line
            self._lines[line.engine.name].config = settings
        self.devices = {d.name: d for line in gateway.lines for d in line.engine.devices}
        self._buses = {d.name: self._lines[s.name] for s in config.lines for d in s.devices}
        self.judge = Judge(gateway, self._buses, self.stations, story, self._began)
        most = 400 + 8 * len(self.judge.known) + 4 * len(drawn.episodes)
        self.expect = Expectations(self.judge, self._lines, seconds, most)
        tags = {tag.key: tag for device in config.devices for tag in device.tags}
        self.faults = Faults(
            *(drawn, self._lines, self.devices, tags),
            *(self.judge, self.expect, Parties(story.seed, self._lines, self.stations)),
            *(self._jump, self.note),
        )

    def _wall(self) -> int:
        return 1_700_000_000 * SECOND + int((self._loop.time() + self._wall_offset) * SECOND)

    def _jump(self, by: float) -> None:
        self._wall_offset += by

    def note(self, *what: object) -> None:
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
            for station in stations.values():
                station.numbered, station.ordered = True, chance.random() < 0.5
        else:
            bus.wire = self._wire(config, bus, by_number, chance)
        return bus.wire.open

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
        station.turnaround = chance.choice((0.001, 0.005, 0.02, 0.05))
        station.other = random.Random(f"other {self.story.seed} {device.name}")
        set_going(station, device.tags)
        self.stations[device.name] = station
        return station

    # The run

    def _tasks(self) -> list[asyncio.Task[None]]:
        """Starts all but the lines: clients, and devices that send by themselves."""
        tasks = []
        haste = 10.0 if self.story.pace == "lean" else 1.0
        for device in self.devices.values():
            bus = self._buses[device.name]
            for who in ("writer", "reader", "boss"):
                chance = random.Random(f"{who} {self.story.seed} {device.name}")
                person = Client(device, self.judge, bus, chance, haste)
                if who == "writer":
                    tasks.append(asyncio.create_task(person.write_now_and_then()))
                elif who == "reader":
                    tasks.append(asyncio.create_task(person.ask_now_and_then()))
                elif device.settings.control and device.driver.protocol == "computer-link":
                    tasks.append(asyncio.create_task(person.command_now_and_then()))
            if isinstance(device.driver, FrameDriver) and device.driver.sends_unsolicited:
                tasks.append(asyncio.create_task(self._speak(device.name, bus)))
        return tasks

    async def _speak(self, name: str, bus: Bus) -> None:
        """Runs a device that sends its weight by itself."""
        station, wire = self.stations[name], bus.wire
        gadget = station.inner
        assert isinstance(gadget, Gadget)
        assert isinstance(wire, SimWire)
        chance = random.Random(f"speaker {self.story.seed} {name}")
        device = self.devices[name]
        weight = next(tag for tag in device.tags if tag.span.area == LISTENED)
        every = self.expect.every(bus, device, weight)
        character = wire.wire.character
        while True:
            await asyncio.sleep(every * chance.uniform(0.8, 1.2))
            if station.deaf or station.mute or station.speaks or chance.random() < station.lose:
                continue
            what = chance.choice((2,) * 30 + (0, 1))
            data = gadget.speak(self._loop.time(), character, what)
            if chance.random() < station.cut:
                data = data[: chance.randrange(1, len(data))]
            elif chance.random() < station.junk:
                data = chance.randbytes(chance.randrange(1, 6)) + data
            elif what == 2:
                self.judge.said(name, gadget)
            wire.speak(data, station)
            first = wire.chunk * character
            whole = not (wire.hanging or station.junk)
            if gadget.wrapping.header and 0 < wire.chunk < len(data) and whole:
                self._loop.call_later(
                    first + 1e-6, self._begun, bus, self._loop.time() + len(data) * character
                )

    def _begun(self, bus: Bus, until: float) -> None:
        """Notes the first byte of an unsolicited frame, if the line was idle then."""
        if bus.line.engine.is_open and bus.line.engine.is_idle:
            bus.speaking = self._loop.time(), until

    async def live(self) -> None:
        lines = [
            asyncio.create_task(line.run(), name=line.engine.name) for line in self.gateway.lines
        ]
        others = [*self._tasks(), asyncio.create_task(self.expect.look_around())]
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
        for task in (everything := [*lines, *others, suffering]):
            task.cancel()
        await asyncio.gather(*everything, return_exceptions=True)
        for bus in self._lines.values():
            if bus.wire.opened != bus.wire.closed:
                self.judge.broke(
                    f"{bus.config.name}: opened {bus.wire.opened} times, closed {bus.wire.closed}"
                )
        self.story.trace = self._trace.hexdigest()


def run(seed: int, hours: float, pace: str = "busy") -> Story:
    """Runs one seed, from drawing its plant to the last check."""
    story = Story(seed, hours, pace)
    seconds = hours * 3600

    async def whole() -> None:
        await World(draw(seed, seconds, pace), story, seconds).live()

    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        run_virtual(whole())
    except Exception as error:  # noqa: BLE001 - whatever it was, the seed is worth knowing
        story.broken.append(f"the run itself ended: {error!r}")
    finally:
        structlog.configure(**before)
    return story
