"""The northbound edge on virtual time: the gateway's Zenoh side, its history, and their clients.

    broken = run(seed, hours=0.2).broken

The Zenoh side and the history are those of `plc-gateway run`, with their threads and the SQLite
file. Zenoh itself is replaced by `virtual_zenoh`, the ports by simulated stations.
"""

import asyncio
import gc
import hashlib
import json
import logging
import random
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import structlog
import zenoh

from gateway.config import Config, LineConfig, load
from gateway.parts.history.settings import HistorySection
from gateway.simulator.port import open_simulator
from gateway.tags import Sample, Tag
from tests.sim.north_clients import Person
from tests.sim.north_gateway import Process, end
from tests.sim.north_judge import BEGIN, Judge, View
from tests.sim.north_peers import Client, Net, Router
from tests.sim.north_plant import Drawn, Fault, Place, Slave, draw
from tests.sim.story import Story
from tests.sim.threads import Turns
from tests.sim.virtual import VirtualLoop, run_virtual
from tests.sim.virtual_threading import replaced
from tests.sim.virtual_zenoh import Received, Session

CALM = 90.0  # seconds at the end without faults
LEASE = 3.0  # seconds
ENDED = 10.0  # seconds
LOOK_EVERY = 2.0  # seconds
FLOOD = 3000  # queries: more than the gateway holds open
_SHM = Path("/dev/shm")  # a file there costs no disk


class World:
    """One gateway, its network and its judge."""

    def __init__(
        self, drawn: Drawn, config: Config, story: Story, seconds: float, turns: Turns
    ) -> None:
        self.drawn, self.story, self.seconds, self.turns = drawn, story, seconds, turns
        self.net = Net(turns)
        self.slaves: dict[str, Slave] = {}
        history = config.part(HistorySection)
        assert history is not None
        self.judge = Judge(story, turns.loop.time(), drawn.refresh, history.keep)
        turns.loop.set_exception_handler(self._crashed)
        self.trace = hashlib.sha256()
        self._sessions = 0
        self._restarting = False
        self.calm, self.traced = CALM, True
        self._config = config
        self.process = Process(config, self.judge, self.wall, self._opener)
        self._build_network()

    def wall(self) -> int:
        return BEGIN * 1000 + int((self.turns.loop.time() - self.judge.began) * 1e9)

    def open(self, config: zenoh.Config) -> Session:
        """Replaces `zenoh.open`."""
        self._sessions += 1
        session = self.net.session = Session(self.turns, config, self._sessions)
        session.puts.append(self.judge.put)
        session.puts.append(self._note)
        return session

    def _crashed(self, _: object, context: dict[str, Any]) -> None:
        self.judge.broke(f"a callback failed: {context.get('exception')!r}")

    def _note(self, key: str, data: bytes) -> None:
        if self.traced and "@gateway" not in key:
            self.trace.update(repr((self.turns.loop.time(), key, data)).encode())

    # Building

    def _opener(self, config: LineConfig) -> Callable[[Any], Any]:
        for device in config.devices:
            if device.name in self.slaves:
                break  # the program of before had the line
            chance = random.Random(f"steps {self.story.seed} {device.name}")
            self.slaves[device.name] = Slave(
                device.driver, list(device.tags), chance, self.drawn, self.judge.executed
            )
        stations = [self.slaves[device.name] for device in config.devices]
        return lambda receiver: open_simulator(stations, config.wire, receiver)

    def _build_network(self) -> None:
        self.routers = {
            name: Router(self.net, name, place) for name, place in self.drawn.routers.items()
        }
        self.viewers = {name: self._client(name, place) for name, place in self._places("viewers")}
        self.people = {name: self._client(name, place) for name, place in self._places("people")}
        tags = [tag for device in self._config.devices for tag in device.tags]
        self.persons = {
            name: Person(
                *(client, self.judge, tags, self._current),
                random.Random(f"{name} {self.story.seed}"),
                rarity=8.0,
            )
            for name, client in self.people.items()
        }
        for name, client in self.viewers.items():
            self._view(client, blocks=name == "viewer2")

    def _current(self, tag: Tag) -> Sample:
        return self.process.gateway.sample(tag)

    def _places(self, group: str) -> list[tuple[str, Place]]:
        return list(getattr(self.drawn, group).items())

    def _client(self, name: str, place: Place) -> Client:
        return Client(self.net, name, place, self.routers.get(place.at))

    def _view(self, client: Client, *, blocks: bool) -> None:
        view = View(client, client.at is not None)
        self.judge.views.append(view)
        client.subscribed = "plant/*/@block" if blocks else "plant/**"

        def take(sample: Received) -> None:
            self.judge.received(view, sample)

        client.take = take

    # Faults

    async def _suffer(self, fault: Fault) -> None:
        await asyncio.sleep(fault.start)
        self.story.counts[fault.kind] += 1
        if fault.target in self.slaves:
            slave = self.slaves[fault.target]
            setattr(slave, fault.kind, getattr(slave, fault.kind) + 1)
            await asyncio.sleep(fault.end - fault.start)
            setattr(slave, fault.kind, getattr(slave, fault.kind) - 1)
            return
        if fault.kind == "restart":
            await self._restart(fault.end - fault.start)
            return
        peer: Any = {**self.routers, **self.viewers, **self.people}[fault.target]
        await getattr(self, f"_{fault.kind}")(peer, fault.end - fault.start)

    async def _restart(self, seconds: float) -> None:
        """The program ends as after SIGTERM, and another one starts."""
        if self._restarting:
            return
        self._restarting = True
        await self.process.stop()
        await asyncio.sleep(seconds)
        self.process = Process(self._config, self.judge, self.wall, self._opener)
        await self.process.start()
        self._restarting = False

    async def _stall(self, peer: Any, seconds: float) -> None:
        peer.link.held += 1
        peer.link.set_rate(0.0)
        await asyncio.sleep(min(seconds, LEASE))
        if seconds > LEASE:
            peer.link.close()  # both ends notice
            await asyncio.sleep(seconds - LEASE)
        peer.link.held -= 1
        if not peer.link.held:
            peer.link.set_rate(1.0)

    _cut = _stall

    async def _flap(self, peer: Any, seconds: float) -> None:
        until = self.net.now + seconds
        chance = random.Random(f"flap {self.story.seed} {until}")
        while self.net.now < until:
            peer.link.close()
            await asyncio.sleep(chance.uniform(0.2, 4.0))

    async def _narrow(self, peer: Any, seconds: float) -> None:
        """Another program uses most of the link."""
        peer.link.set_rate(min(1.0, 2_000 / peer.link.rate))
        await asyncio.sleep(seconds)
        if not peer.link.held:
            peer.link.set_rate(1.0)

    async def _flood(self, client: Client, seconds: float) -> None:
        """The program asks a lot, and receives nothing."""
        link = client.link
        if not link.is_up:
            return
        link.held += 1
        link.down.set_rate(0.0)
        key = f"plant/{self.persons['asker'].tags[0].key}"
        async with asyncio.TaskGroup() as tasks:
            for _ in range(FLOOD):
                tasks.create_task(client.get(key, LEASE))
        link.close()
        link.held -= 1

    async def _leave(self, client: Client, seconds: float) -> None:
        client.link.barred += 1
        client.leave()
        await asyncio.sleep(seconds)
        client.link.barred -= 1

    # The run

    async def live(self) -> None:
        await self.process.start()
        links = [peer.link for peer in self.routers.values()]
        links += [peer.link for peer in (*self.viewers.values(), *self.people.values())]
        others = [asyncio.create_task(link.keep_open()) for link in links]
        others += [asyncio.create_task(self._look())]
        people = [
            asyncio.create_task(self.persons["asker"].ask_now_and_then()),
            asyncio.create_task(self.persons["reader"].ask_now_and_then()),
            asyncio.create_task(self.persons["writer"].write_now_and_then()),
        ]
        faults = [asyncio.create_task(self._suffer(fault)) for fault in self.drawn.faults]
        watched = [*others, *people]
        done, _ = await asyncio.wait(
            watched, timeout=self.seconds, return_when=asyncio.FIRST_COMPLETED
        )
        for task in done:
            self.judge.broke(f"{task.get_name()} failed by itself: {task.exception()!r}")
        await asyncio.sleep(self.calm)
        await end(people)
        await asyncio.sleep(ENDED)  # their last writes have ended
        await self._at_the_end()
        await end([*others, *faults])
        await self.process.stop()
        for link in links:
            self.story.counts["lost by congestion"] += link.lost[0]
        self.story.trace = self.trace.hexdigest()

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(LOOK_EVERY)
            self.judge.look()
            if not self._restarting:
                self.process.look()
            for crash in self.turns.crashed:
                self.judge.broke(crash)
            self.turns.crashed.clear()

    async def _at_the_end(self) -> None:
        """All is calm, and a client with a good link finds everything."""
        client = Client(self.net, "last", Place(10_000_000.0, 0.001, 16_384, ""))
        opening = asyncio.create_task(client.link.keep_open())
        await asyncio.sleep(1.0)
        person = Person(
            *(client, self.judge, self.persons["asker"].tags, self._current),
            random.Random(0),
            rarity=8.0,
        )
        for ask in (person.all_now, person.pages_now, person.past, person.past_in_pages):
            if not await ask():
                self.judge.broke(f"{ask.__name__} gets no whole answer, and all is calm")
        outcomes = await person.outcomes()
        if outcomes is None:
            self.judge.broke("the record of writes gets no whole answer, and all is calm")
        else:
            self.judge.at_the_end(outcomes)
        await end([opening])


def run(
    seed: int,
    hours: float,
    pace: str = "north",
    only: Sequence[str] = (),
    *,
    traced: bool = True,
    calm: float = CALM,
) -> Story:
    """Runs one seed. `only`: the kinds of faults that happen; empty: all. `calm`: seconds without
    faults at the end; with less the judge complains."""
    story = Story(seed, hours, pace, tuple(only))

    async def whole(folder: Path) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        turns, worlds = Turns(loop), list[World]()

        def opened(config: zenoh.Config) -> Session:
            return worlds[0].open(config)

        def wall() -> int:
            return worlds[0].wall()

        drawn = draw(seed, hours * 3600, calm, folder)
        if only:
            kept = tuple(fault for fault in drawn.faults if fault.kind in only)
            drawn = replace(drawn, faults=kept)
        path = folder / "config.yaml"
        path.write_text(json.dumps(drawn.document))
        with replaced(opened, turns, wall):
            try:
                worlds.append(World(drawn, load(path), story, hours * 3600, turns))
                worlds[0].calm, worlds[0].traced = calm, traced
                await worlds[0].live()
            finally:
                turns.end()

    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        with tempfile.TemporaryDirectory(dir=_SHM if _SHM.is_dir() else None) as name:
            run_virtual(whole(Path(name)))
    except Exception as error:  # noqa: BLE001 - whatever it was, the seed is worth knowing
        story.broken.append(f"the run itself ended: {error!r}")
    finally:
        structlog.configure(**before)
        gc.collect()
    return story
