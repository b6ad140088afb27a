"""Programs at the doors of a line with faults, and a judge of every reply and value.

Each register holds its own number, and two hold what each program wrote last. So a reply that
belongs to another request shows itself, and so does a write that was acknowledged and not done.
`make sim PACE=doors` runs seeds.
"""

import asyncio
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from struct import pack, unpack_from
from typing import Any

from gateway.config import LineConfig, built
from gateway.contract.keys import Keys
from gateway.engine.device.changes import Changes
from gateway.line.opening import OpenPort
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import OwnWrites
from gateway.parts.doors.guest import Guest
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.open_door import OpenDoor
from gateway.parts.doors.settings import Sharing
from gateway.parts.doors.tunnel import Tunnel
from gateway.plant.plant import Plant
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.rtu import encode
from gateway.stations.modbus.station import ModbusStation
from gateway.tags import Quality, Sample, Tag, WriteResult
from gateway.values import Value
from tests.sim.bench import Bench, Unruly
from tests.sim.story import Story
from tests.sim.virtual import now, on_virtual_time

POLLED, OWN, LAST = range(100, 140), 500, 1000  # addresses
PATIENCE = (0.3, 0.7, 1.2)  # seconds that a program waits; `reply_within` is 1 s


def _file(draw: random.Random) -> dict[str, Any]:
    tags = {f"t{n}": {"address": f"holding:{n}"} for n in POLLED if draw.random() < 0.5}
    doors = {
        protocol: {
            "line": "hall",
            "listen": f"127.0.0.1:{1500 + place}",
            "protocol": protocol,
            "writes": {"press": [f"holding:{OWN}..{OWN + 9}"]},
            "most": draw.choice(("20%", "50%", "90%")),
            **draw.choice(({}, {"max_age": "300ms"}, {"max_age": "5s"})),
        }
        for place, protocol in enumerate(("modbus-tcp", "modbus-rtu"))
    }
    doors["raw"] = {"line": "hall", "listen": "127.0.0.1:1502", "protocol": "raw"}
    # What the programs write is polled too: a value from before a write is no answer to them.
    tags |= {f"own{n}": {"address": f"holding:{n}"} for n in (OWN, OWN + 1)}
    press = {
        "protocol": "modbus-rtu",
        "station": 1,
        "defaults": {"every": draw.choice(("100ms", "300ms", "1s"))},
        "reply_timeout": draw.choice(("100ms", "300ms")),
        "tags": tags | {"t99": {"address": "holding:99"}},
    }
    hall = {"port": "/dev/ttyS99", "baudrate": 19200, "devices": {"press": press}}
    return {"lines": {"hall": hall}, "share": {"doors": doors}}


@dataclass(eq=False)
class Program:
    """A master of a maker's: it takes each reply that has the form of the one it waits for."""

    world: "World"
    numbered: bool
    draw: random.Random
    own: int  # the register that it writes
    patience: float
    guest: Guest | Tunnel | None = None
    heard: bytearray = field(default_factory=bytearray)
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    value: int | None = 0  # of its register, None: a write was not acknowledged
    number: int = 0

    # The port of the guest

    def write(self, data: bytes) -> None:
        self.heard += data
        self.arrived.set()

    async def close(self) -> None:
        self.guest = None

    # The master

    async def work(self, door: OpenDoor) -> None:
        while True:
            await asyncio.sleep(self.draw.choice((0.0, 0.02, 0.3, 2.0)))
            if self.guest is None or self.draw.random() < 0.01:
                if self.guest is not None:
                    self.guest.lost(OSError("gone"))
                self.guest = door.connect("127.0.0.1")
                assert self.guest is not None
                self.guest.opened(self)
            if self.draw.random() < 0.3:
                await self._write()
            elif self.draw.random() < 0.3:
                await self._read(self.own, 1)
            else:
                first = self.draw.randrange(LAST - 400, LAST - 10)
                await self._read(first, self.draw.randint(1, 4))

    async def _write(self) -> None:
        value = self.draw.randrange(1, 65536)
        before, self.value = self.value, None
        reply = await self._ask(b"\x06" + pack(">HH", self.own, value), 5)
        if reply is None:
            return
        if reply[0] & 0x80:
            # 06: it was not sent. 0B: nobody knows.
            self.value = before if reply[1] != 0x0B else None
            self.world.count("write refused")
            return
        self.world.judge(reply[1:5] == pack(">HH", self.own, value), "another write's reply")
        held = self.world.station.memory.read("holding", self.own, 1)[0]
        self.world.judge(held == value, f"acknowledged {value}, but it holds {held}")
        self.value = value
        self.world.count("written")

    async def _read(self, first: int, count: int) -> None:
        reply = await self._ask(b"\x03" + pack(">HH", first, count), 2 + 2 * count)
        if reply is None:
            return
        if reply[0] & 0x80:
            self.world.count("read refused")
            return
        found = [int.from_bytes(reply[at : at + 2]) for at in range(2, len(reply), 2)]
        if first != self.own:
            self.world.judge(found == [*range(first, first + count)], f"{first} read as {found}")
        elif self.value is not None:
            self.world.judge(found == [self.value], f"{self.value} was written, read as {found}")
        self.world.count("read")

    async def _ask(self, pdu: bytes, size: int) -> bytes | None:
        """Returns the PDU of the reply; None after its patience. `size`: of a good one."""
        self.heard.clear()
        self.number = self.number % 65535 + 1
        request = encode(Frame(1, pdu))
        if self.numbered:
            request = pack(">HHHB", self.number, 0, len(pdu) + 1, 1) + pdu
        if self.guest is None:
            return None
        self.guest.received(request)
        try:
            async with asyncio.timeout(self.patience):
                while True:
                    self.arrived.clear()
                    await self.arrived.wait()
                    if (found := self._taken(pdu[0], size)) is not None:
                        return found
        except TimeoutError:
            self.world.count("no reply")
            return None

    def _taken(self, function: int, size: int) -> bytes | None:
        """Returns a reply; one with another number is passed over."""
        heard = self.heard
        while self.numbered and len(heard) > 7:
            number, _, length = unpack_from(">HHH", heard)
            whole, found = 6 + length, bytes(heard[7 : 6 + length])
            if len(heard) < whole:
                return None
            del heard[:whole]
            if number == self.number:
                return found
        if self.numbered or len(heard) < 5 or heard[0] != 1 or heard[1] & 0x7F != function:
            return None
        return bytes(heard[1:3] if heard[1] & 0x80 else heard[1 : 1 + size])


class Nowhere:
    """The port of a program that reads nothing."""

    def write(self, data: bytes) -> None: ...

    async def close(self) -> None: ...


class World:
    """One line with faults, its plant, and two programs."""

    def __init__(self, seed: int) -> None:
        self.draw, self.found = random.Random(seed), Counter[str]()
        self.wrong: list[str] = []
        config = built(_file(self.draw))
        inner = ModbusStation(station=1)
        inner.memory.write("holding", 0, range(LAST))
        for own in (OWN, OWN + 1):
            inner.memory.write("holding", own, [0])
        self.station = Unruly(inner, seed, late=self._late)  # type: ignore[arg-type]
        self.station.answer = self._answers
        self.bench = Bench(seed=seed)
        self.plant = Plant(config, lambda: int(now() * 1e9), self._open)
        self.plant.subscribe(self)
        keys = Keys("plant", "demo")
        self._own = OwnWrites(keys, self.plant, Audit(lambda _: None))
        self._slow = self._twice = 0.0
        sharing = config.part(Sharing)
        assert sharing is not None
        self.doors = sharing.doors

    def judge(self, good: bool, what: str) -> None:
        if not good:
            self.wrong.append(f"{now():.3f} {what}")

    def count(self, what: str) -> None:
        self.found[what] += 1

    # The wire

    def _open(self, config: LineConfig) -> OpenPort:
        return lambda receiver: self.bench.open([self.station], config.wire, receiver)

    def _late(self, draw: random.Random) -> float:
        return draw.choice((0.05, 0.25, 0.6, 1.5)) if draw.random() < self._slow else 0.0

    def _answers(self, data: bytes, at: float) -> list[bytes]:
        replies = self.station.inner.hear(data, at)
        return replies * 2 if self.draw.random() < self._twice else replies

    # The subscriber of the plant, and its Zenoh side

    def publish(self, samples: Sequence[Sample]) -> None:
        for one in samples:
            if one.quality is Quality.GOOD and one.tag.span.start < OWN:
                self.count("value")
                self.judge(one.value == one.tag.span.start, f"{one.tag.key} became {one.value}")

    def set_online(self, device: str, online: bool) -> None: ...

    async def write_own(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> WriteResult:
        return await self._own.write(tag, value, by, within, repeated=repeated)

    # The story

    async def _reload_now_and_then(self, doors: Sequence[OpenDoor]) -> None:
        """Changes the device of the file: its programs connect again."""
        while True:
            await asyncio.sleep(self.draw.choice((20.0, 200.0)))
            [line] = self.plant.lines
            [old] = line.engine.devices
            guard = 0.5 + self.draw.random()
            new = old.successor(replace(old.settings, late_guard=guard), old.bad_addresses.known())
            new.plan()
            applied = partial(self.plant.move, (), line, [new])
            await line.change(Changes(replaced=[(old, new)]), (), applied)
            for guest in [guest for door in doors for guest in door.guests]:
                guest.leave()
            self.count("reload")

    async def _have_the_wire_now_and_then(self, door: OpenDoor) -> None:
        """A tool that goes while the station may still answer it, or is sent away."""
        while True:
            await asyncio.sleep(self.draw.choice((10.0, 100.0)))
            if (tunnel := door.connect("127.0.0.1")) is None:
                continue  # it was released a short time ago
            tunnel.opened(Nowhere())
            for _ in range(self.draw.randrange(4)):
                await asyncio.sleep(self.draw.choice((0.05, 1.0)))
                tunnel.received(
                    encode(Frame(1, b"\x03" + pack(">HH", self.draw.randrange(900), 1)))
                )
            await asyncio.sleep(self.draw.choice((0.0, 0.01, 3.0)))
            if self.draw.random() < 0.5:
                door.release("the judge")
            else:
                tunnel.lost(OSError("gone"))
            self.count("wire lent")

    async def run(self, seconds: float) -> None:
        """Runs the programs for so long, while the wire has one fault after another."""
        turns = GuestRequests(self.plant.any_address, self)  # type: ignore[arg-type]
        ends = now() + seconds
        async with asyncio.TaskGroup() as tasks:
            work = [tasks.create_task(line.run()) for line in self.plant.lines]
            made = [
                OpenDoor(settings, turns, self.plant, tasks, lambda _at, _event: None)
                for settings in self.doors
            ]
            raw = made.pop()
            work.append(tasks.create_task(self._reload_now_and_then(made)))
            work.append(tasks.create_task(self._have_the_wire_now_and_then(raw)))
            for place, (settings, door) in enumerate(zip(self.doors, made, strict=False)):
                numbered, draw = (
                    settings.protocol == "modbus-tcp",
                    random.Random(self.draw.random()),
                )
                patience = self.draw.choice(PATIENCE)
                program = Program(self, numbered, draw, OWN + place, patience)
                work.append(tasks.create_task(program.work(door)))
            while now() < ends:
                match self.draw.choice(("slow", "twice", "lose", "cut", "mute", "calm", "vanish")):
                    case "slow":
                        self._slow = self.draw.choice((0.05, 0.3, 0.9))
                    case "twice":
                        self._twice = self.draw.choice((0.1, 1.0))
                    case "lose":
                        self.station.lose = 0.2
                    case "cut":
                        self.station.cut = 0.2
                    case "mute":
                        self.station.mute = True
                    case "vanish":
                        self.bench.vanish()
                await asyncio.sleep(self.draw.choice((0.5, 5.0, 30.0)))
                self._slow = self._twice = self.station.lose = self.station.cut = 0.0
                self.station.mute = False
                self.bench.come_back()
                await asyncio.sleep(self.draw.choice((0.5, 5.0)))
            for one in work:
                one.cancel()
            self.plant.unsubscribe(self)
            raise _Over


class _Over(Exception):
    """The story has ended: the programs and requests that still wait end with it."""


def run(seed: int, seconds: float) -> World:
    """Returns the world after so many seconds of its time."""
    worlds: list[World] = []

    @on_virtual_time
    async def story() -> None:
        worlds.append(World(seed))
        try:
            await worlds[0].run(seconds)
        except* _Over:
            pass

    story()
    return worlds[0]


def story(
    seed: int, hours: float, pace: str, only: Sequence[str] = (), *, traced: bool = True
) -> Story:
    """Runs a seed for `make sim PACE=doors`."""
    world = run(seed, hours * 3600)
    return Story(seed, hours, pace, tuple(only), world.wrong, world.found)
