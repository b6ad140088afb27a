"""Programs at the doors of a line with faults, and a judge of every reply, value and write.

The gateway is reloaded, held, and replaced by another one of its group. Each register holds its own
number, and two hold what each program wrote last. So a reply that belongs to another request shows
itself, and so does a write that was acknowledged and not done.
`make sim PACE=doors` runs seeds.
"""

import asyncio
import random
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from struct import pack, unpack_from
from typing import Any

from gateway.config import LineConfig, built
from gateway.contract.keys import Keys
from gateway.engine.device.changes import Changes
from gateway.line.arrival import HELD, ArrivalClock
from gateway.line.opening import OpenPort
from gateway.line.send_permit import PROOF_VALID, SendPermit
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
from tests.sim.door_wire import SharedWire
from tests.sim.freezer import Ear, Freezer
from tests.sim.story import Story
from tests.sim.virtual import now, on_virtual_time

POLLED, OWN, LAST = range(100, 140), 500, 1000  # addresses
# Seconds: `reply_within`, a hold that is too short to be noticed, and the request on the wire.
STALE = 1.0 + HELD + 0.2
DOORS = ("modbus-tcp", "modbus-rtu")
TAKES_OVER = 3.7  # seconds from the end of one gateway to the next
LENGTHS, HOLDS = (0.5, 5.0, 30.0), (0.3, 1.0, 5.0)  # seconds of a fault, of a held process
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
        for place, protocol in enumerate(DOORS)
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
    door: OpenDoor | None = None  # None: no gateway is active
    guest: Guest | Tunnel | None = None
    ear: Ear | None = None  # of the guest: it hears nothing while its process is held
    heard: bytearray = field(default_factory=bytearray)
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    value: int | None = 0  # of its register, None: a write was not acknowledged
    asked: dict[int, float] = field(default_factory=dict)  # when, by the value to write
    number: int = 0
    patience: float = 1.0

    # The port of the guest

    def write(self, data: bytes) -> None:
        self.heard += data
        self.arrived.set()

    async def close(self) -> None:
        self.guest = None

    # The master

    async def work(self) -> None:
        self.patience = self.draw.choice(PATIENCE)
        while True:
            await asyncio.sleep(self.draw.choice((0.0, 0.02, 0.3, 2.0)))
            if self.ear is not None and self.guest is not None and self.draw.random() < 0.01:
                self.world.inside.run(self.ear.lost, OSError("gone"))
                self.guest = None
            if self.guest is None and (self.door is None or not self._connect(self.door)):
                continue
            if self.draw.random() < 0.3:
                await self._write()
            elif self.draw.random() < 0.3:
                await self._read(self.own, 1)
            else:
                first = self.draw.randrange(LAST - 400, LAST - 10)
                await self._read(first, self.draw.randint(1, 4))

    def _connect(self, door: OpenDoor) -> bool:
        if self.world.freezer.frozen:
            return False
        inside = self.world.inside
        self.guest = inside.run(door.connect, "127.0.0.1")
        assert self.guest is not None
        self.ear = Ear(self.world.freezer, self.guest)
        inside.run(self.guest.opened, self)
        return True

    async def _write(self) -> None:
        value = self.draw.randrange(1, 65536)
        before, self.value = self.value, None
        self.asked[value] = now()
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
        if self.guest is None or self.ear is None:
            return None
        self.world.inside.run(self.ear.received, request)
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
    """A wire with faults, two programs, and one gateway after another."""

    def __init__(self, seed: int, only: Sequence[str] = ()) -> None:
        self._only = only  # kinds of faults; empty: all
        self.draw, self.found = random.Random(seed), Counter[str]()
        self.wrong: list[str] = []
        self.freezer = Freezer()
        self.freezer.install()
        self.inside = self.freezer.inside()
        self.config = built(_file(self.draw))
        inner = ModbusStation(station=1)
        inner.memory.write("holding", 0, range(LAST))
        for own in (OWN, OWN + 1):
            inner.memory.write("holding", own, [0])
        self.station = Unruly(inner, seed, late=self._late)  # type: ignore[arg-type]
        self.station.answer = self._answers
        [hall] = self.config.lines
        self.wire = SharedWire(Bench(seed=seed), [self.station], hall.wire)
        self.programs = [
            Program(self, protocol == "modbus-tcp", random.Random(self.draw.random()), OWN + place)
            for place, protocol in enumerate(DOORS)
        ]
        self.life: Life | None = None
        self.ends = asyncio.Event()  # of this gateway's time as the active one
        self.doubted = 0.0  # since then another gateway may be the active one; 0: no
        self._slow = self._twice = 0.0

    def judge(self, good: bool, what: str) -> None:
        if not good:
            self.wrong.append(f"{now():.3f} {what}")

    def count(self, what: str) -> None:
        self.found[what] += 1

    def _late(self, draw: random.Random) -> float:
        return draw.choice((0.05, 0.25, 0.6, 1.5)) if draw.random() < self._slow else 0.0

    def _answers(self, data: bytes, at: float) -> list[bytes]:
        replies = self.station.inner.hear(data, at)
        if replies and data[:2] == b"\x01\x06":
            address, value = unpack_from(">HH", data, 2)
            self._judge_write(address, value, at)
        return replies * 2 if self.draw.random() < self._twice else replies

    def _judge_write(self, address: int, value: int, at: float) -> None:
        """Judges a write that reached the PLC; one that a stall has held back may be old."""
        asked = next(one.asked for one in self.programs if one.own == address)
        if self.wire.stalled_at + STALE < at:
            age = at - asked[value]
            self.judge(age < STALE, f"{value} was written {age:.1f} s after it was asked for")
            doubt = at - (self.doubted or at)
            self.judge(
                doubt < PROOF_VALID + 0.2, f"{value} was written in a doubt of {doubt:.1f} s"
            )

    async def run(self, seconds: float) -> None:
        """Runs the programs for so long, while the wire has one fault after another."""
        ends = now() + seconds
        async with asyncio.TaskGroup() as tasks:
            work = [tasks.create_task(program.work()) for program in self.programs]
            lives = asyncio.get_running_loop().create_task(self._gateways(), context=self.inside)
            while now() < ends:
                await self._fault()
            for one in (lives, *work):
                one.cancel()
            await asyncio.wait([lives])

    async def _fault(self) -> None:
        begin: dict[str, Callable[[], None]] = {
            "calm": lambda: None,
            "mute": partial(setattr, self.station, "mute", True),
            "lose": partial(setattr, self.station, "lose", 0.2),
            "cut": partial(setattr, self.station, "cut", 0.2),
            "slow": partial(setattr, self, "_slow", self.draw.choice((0.05, 0.3, 0.9))),
            "twice": partial(setattr, self, "_twice", self.draw.choice((0.1, 1.0))),
            "vanish": self.wire.bench.vanish,
            "stall": self.wire.stall,
            "held": self.freezer.freeze,
            "doubts": partial(setattr, self, "doubted", now()),
            "standby": self.ends.set,
        }
        fault = self.draw.choice([one for one in begin if one in (self._only or begin)])
        begin[fault]()
        self.count(fault)
        await asyncio.sleep(self.draw.choice(HOLDS if fault == "held" else LENGTHS))
        self._slow = self._twice = self.station.lose = self.station.cut = 0.0
        self.station.mute, self.doubted = False, 0.0
        self.wire.bench.come_back()
        if fault == "stall":
            await self.wire.flow()
        if fault == "held":
            self.freezer.thaw()
        await asyncio.sleep(self.draw.choice((0.5, 5.0)))

    async def _gateways(self) -> None:
        """Runs a gateway until another one of its group takes over, again and again."""
        while True:
            self.ends.clear()
            self.life = Life(self)
            try:
                await self.life.run()
            except* _Over:
                pass
            finally:
                self.life = None
            for program in self.programs:
                program.guest = program.door = None
            await asyncio.sleep(TAKES_OVER)
            for program in self.programs:  # the other gateway has a door, too
                program.value = self.draw.randrange(1, 65536)
                self.station.memory.write("holding", program.own, [program.value])


class Life:
    """One gateway with its doors, from its start to its end."""

    def __init__(self, world: World) -> None:
        self._world, self._draw = world, world.draw
        self._clock = ArrivalClock(lambda: int(now() * 1e9))
        self._duty = SendPermit(self._clock.released, shared=True)
        self.plant = Plant(world.config, self._clock, self._open, self._duty)
        keys = Keys("plant", "demo")
        self._own = OwnWrites(keys, self.plant, Audit(lambda _: None))
        self.plant.subscribe(self)

    def _open(self, _config: LineConfig) -> OpenPort:
        return lambda receiver: self._world.wire.open(receiver, self._world.freezer)

    # The subscriber of the plant, and its Zenoh side

    def publish(self, samples: Sequence[Sample]) -> None:
        for one in samples:
            if one.quality is Quality.GOOD and one.tag.span.start < OWN:
                self._world.count("value")
                good = one.value == one.tag.span.start
                self._world.judge(good, f"{one.tag.key} became {one.value}")

    def set_online(self, device: str, online: bool) -> None: ...

    async def write_own(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> WriteResult:
        return await self._own.write(tag, value, by, within, repeated=repeated)

    def deny_own(self, tag: Tag, value: Value | None, by: str, why: str) -> None:
        self._own.deny(tag, value, by, why)

    # Its work

    async def run(self) -> None:
        """Runs until it is no longer the active gateway. Raises `_Over`."""
        turns = GuestRequests(self.plant.any_address, self)  # type: ignore[arg-type]
        sharing = self._world.config.part(Sharing)
        assert sharing is not None
        self._clock.start()
        try:
            async with asyncio.TaskGroup() as tasks:
                for line in self.plant.lines:
                    tasks.create_task(line.run())
                made = [
                    OpenDoor(settings, turns, self.plant, tasks, lambda _at, _event: None)
                    for settings in sharing.doors
                ]
                raw = made.pop()
                for program, door in zip(self._world.programs, made, strict=True):
                    program.door = door
                tasks.create_task(self._reload_now_and_then(made))
                tasks.create_task(self._have_the_wire_now_and_then(raw))
                tasks.create_task(self._prove())
                await self._world.ends.wait()
                raise _Over
        finally:
            self._clock.stop()
            self.plant._subscribers.remove(self)

    async def _prove(self) -> None:
        while True:
            if not self._world.doubted:
                self._duty.prove(now())
            await asyncio.sleep(0.5)

    async def _reload_now_and_then(self, doors: Sequence[OpenDoor]) -> None:
        """Changes the device of the file: its programs connect again."""
        while True:
            await asyncio.sleep(self._draw.choice((20.0, 200.0)))
            [line] = self.plant.lines
            [old] = line.engine.devices
            guard = 0.5 + self._draw.random()
            new = old.successor(replace(old.settings, late_guard=guard), old.bad_addresses.known())
            new.plan()
            applied = partial(self.plant.move, (), line, [new])
            await line.change(Changes(replaced=[(old, new)]), (), applied)
            for guest in [guest for door in doors for guest in door.guests]:
                guest.leave()
            self._world.count("reload")

    async def _have_the_wire_now_and_then(self, door: OpenDoor) -> None:
        """A tool that goes while the station may still answer it, or is sent away."""
        while True:
            await asyncio.sleep(self._draw.choice((10.0, 100.0)))
            if (tunnel := door.connect("127.0.0.1")) is None:
                continue  # it was released a short time ago
            tunnel.opened(Nowhere())
            for _ in range(self._draw.randrange(4)):
                await asyncio.sleep(self._draw.choice((0.05, 1.0)))
                asked = pack(">HH", self._draw.randrange(900), 1)
                tunnel.received(encode(Frame(1, b"\x03" + asked)))
            await asyncio.sleep(self._draw.choice((0.0, 0.01, 3.0)))
            if self._draw.random() < 0.5:
                door.release("the judge")
            else:
                tunnel.lost(OSError("gone"))
            self._world.count("wire lent")


class _Over(Exception):
    """The gateway is no longer the active one: its programs and requests end with it."""


def run(seed: int, seconds: float, only: Sequence[str] = ()) -> World:
    """Returns the world after so many seconds of its time. `only`: kinds of faults."""
    worlds: list[World] = []

    @on_virtual_time
    async def story() -> None:
        worlds.append(World(seed, only))
        await worlds[0].run(seconds)

    story()
    return worlds[0]


def story(
    seed: int, hours: float, pace: str, only: Sequence[str] = (), *, traced: bool = True
) -> Story:
    """Runs a seed for `make sim PACE=doors`."""
    world = run(seed, hours * 3600, only)
    return Story(seed, hours, pace, tuple(only), world.wrong, world.found)
