"""Histories of writes, checked against what a PLC did: `python -m tests.faults.histories`.

Two gateways of a standby group behind a router write to pymodbus' server. Meanwhile gateways are
killed, paused and started again, their clocks jump, the router dies, and the wire is cut or held.
The checker knows only the clients' answers and the server's own list: each value is written once.
"""

import argparse
import asyncio
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tests.e2e.processes import Program, free_port, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

MOST = 60_000  # values of a register: each is written once
GOES_ON = 60.0  # seconds after a fault, before the next one: a loaded machine starts slowly
LATE = 0.5  # seconds that the lists of two processes may differ
# The command itself, with a wall clock that jumps to and fro by an hour at SIGUSR1.
RUN = """
import signal, time
real, off = time.time_ns, [0]
time.time_ns = lambda: real() + off[0]
signal.signal(signal.SIGUSR1, lambda *_: off.__setitem__(0, 0 if off[0] else 3600 * 10**9))
from gateway.cli.main import main
main()
"""
PLC = """
import asyncio, json, sys, time
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
done = open(sys.argv[2], "a", buffering=1)
def trace(sending, pdu):
    if sending and pdu.function_code == 6:
        line = [pdu.address, pdu.registers[0], time.monotonic()]
        done.write(json.dumps(line) + chr(10))
    return pdu
async def main():
    words = [SimData(0, values=[0] * 100, datatype=DataType.REGISTERS)]
    device = SimDevice(id=1, simdata=words)
    server = ModbusTcpServer([device], address=("127.0.0.1", int(sys.argv[1])), trace_pdu=trace)
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await asyncio.Event().wait()
asyncio.run(main())
"""
CLIENT = """
import json, sys, time, zenoh
config = zenoh.Config()
settings = {"mode": "client", "connect/endpoints": [sys.argv[1]], "connect/timeout_ms": 60000,
    "scouting/multicast/enabled": False}
for path, value in settings.items():
    config.insert_json5(path, json.dumps(value))
key, first, last = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
target = zenoh.QueryTarget.ALL
with zenoh.open(config) as session, open(sys.argv[5], "a", buffering=1) as out:
    for value in range(first, last):
        begun, answers = time.monotonic(), []
        for reply in session.get(key, payload=str(value), timeout=8.0, target=target):
            if reply.ok:
                answers.append("written")
            else:
                try:
                    answers.append(json.loads(reply.err.payload.to_string())["error"])
                except ValueError:
                    answers.append("timeout")
        out.write(json.dumps([value, begun, time.monotonic(), answers]) + chr(10))
        if answers != ["written"]:
            time.sleep(0.5)
"""


class Asked(NamedTuple):
    """A write as its client saw it. Times by the clock that all processes have."""

    value: int
    begun: float
    ended: float
    answers: tuple[str, ...]


class Done(NamedTuple):
    """A write as the PLC executed it."""

    value: int
    at: float


# Answers after which nothing may have been written, then or later.
NOT_DONE = {"busy", "no-reply", "line-down", "not-sent", "bad-value", "unknown-tag", "refused"}


def wrong(asked: Iterable[Asked], done: Sequence[Done]) -> Iterator[str]:
    """Yields each contradiction between the answers for one register and what its PLC did.

    A write that is told as written was executed once, between question and answer. One that is told
    as not done was never executed. Any other may have been executed once. So the history is
    linearizable: each execution has its place between the question and the end of its doubt.
    """
    counts, times = Counter(each.value for each in done), {each.value: each.at for each in done}
    known = set[int]()
    for one in asked:
        known.add(one.value)
        executed, answers = counts[one.value], Counter(one.answers)
        if executed > 1:
            yield f"{one.value} was written {executed} times: {one.answers}"
        if answers["written"] > 1:
            yield f"{one.value} has two acknowledgements"
        if answers["written"] and not executed:
            yield f"{one.value} was told as written, and was not"
        elif answers["written"] and not one.begun - LATE <= times[one.value] <= one.ended + LATE:
            yield f"{one.value} was told as written before it was"
        elif executed and answers and set(answers) <= NOT_DONE:
            yield f"{one.value} was written, and told as {one.answers}"
    for value in counts.keys() - known:
        yield f"{value} was written, and nobody asked for it"


class Found(NamedTuple):
    """The histories of all registers."""

    asked: dict[int, list[Asked]]
    done: dict[int, list[Done]]

    def wrong(self) -> list[str]:
        return [
            f"register {tag}: {sentence}"
            for tag, asked in self.asked.items()
            for sentence in wrong(asked, self.done.get(tag, []))
        ]

    def outcomes(self) -> Counter[str]:
        return Counter(
            "+".join(sorted(one.answers)) or "none" for each in self.asked.values() for one in each
        )


@dataclass
class Wire:
    """The way to the PLC: it can be cut, or hold everything for a while."""

    plc: int
    flows: asyncio.Event = field(default_factory=asyncio.Event)
    links: set[asyncio.StreamWriter] = field(default_factory=set)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self.plc)
        self.links |= {writer, back}
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(self._pass(reader, back))
                both.create_task(self._pass(there, writer))
        finally:
            self.links -= {writer, back}
            writer.close()
            back.close()

    async def _pass(self, source: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await source.read(4096):
                await self.flows.wait()
                to.write(data)
            to.close()

    def cut(self) -> None:
        for link in list(self.links):
            link.transport.abort()


@dataclass
class World:
    """All processes, and the faults that befall them."""

    folder: Path
    chance: random.Random
    wire: Wire
    router: ZenohPeer
    at_router: str
    gateways: list[Program] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)

    def start(self, place: int) -> None:
        program = Program(sys.executable, "-c", RUN, "run", self.files[place])
        self.gateways[place : place + 1] = [program]

    def executed(self) -> int:
        """Returns the size of the PLC's list: it grows while writes are done."""
        return (self.folder / "plc.jsonl").stat().st_size

    def end(self) -> None:
        for program in self.gateways:
            program.__exit__()

    async def befall(self) -> None:
        """One fault, and its end."""
        place = self.chance.randrange(2)
        victim = self.gateways[place]
        fault = self.chance.choice(("kill", "end", "pause", "clock", "router", "cut", "hold"))
        self.faults[fault] += 1
        match fault:
            case "kill" | "end":
                by = signal.SIGKILL if fault == "kill" else signal.SIGTERM
                await asyncio.to_thread(victim.end, by)
                self.start(place)
            case "pause":
                os.kill(victim.pid, signal.SIGSTOP)
                await asyncio.sleep(self.chance.choice((0.3, 2.0, 7.0)))
                os.kill(victim.pid, signal.SIGCONT)
            case "clock":
                os.kill(victim.pid, signal.SIGUSR1)
            case "router":
                await self.router.kill()
                await asyncio.sleep(self.chance.choice((0.1, 4.0)))
                self.router = ZenohPeer("router", listen=[self.at_router])
                await self.router.__aenter__()
            case "cut":
                self.wire.cut()
            case "hold":
                self.wire.flows.clear()
                await asyncio.sleep(self.chance.choice((0.1, 0.7, 3.0)))
                self.wire.flows.set()


@asynccontextmanager
async def world(folder: Path, tags: int, seed: int) -> AsyncIterator[World]:
    plc_port, port = free_port(), free_port()
    at_router = free_endpoint()
    async with AsyncExitStack() as stack:
        plc = Program(sys.executable, "-c", PLC, plc_port, folder / "plc.jsonl")
        stack.enter_context(plc)
        await asyncio.to_thread(plc.says, "ready")
        wire = Wire(plc_port)
        wire.flows.set()
        server = await asyncio.start_server(wire.serve, "127.0.0.1", port)
        stack.push_async_callback(server.wait_closed)
        stack.callback(server.close)
        router = ZenohPeer("router", listen=[at_router])
        await router.__aenter__()
        made = World(folder, random.Random(seed), wire, router, at_router)
        stack.push_async_callback(lambda: made.router.__aexit__(None, None, None))
        device = {
            "protocol": "modbus-tcp",
            "station": 1,
            "reply_timeout": "1s",
            "tags": {f"t{n}": {"address": f"holding:{n}", "write": True} for n in range(tags)},
        }
        for name in ("left", "right"):
            (folder / name).mkdir()
            made.files.append(
                write_config(
                    folder / name / "plant.yaml",
                    "",
                    {"hall": {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}},
                    gateway={"name": name, "standby": "hall", "state": "state.json"},
                    zenoh={
                        "mode": "client",
                        "prefix": "plant",
                        "listen": [],
                        "connect": [at_router],
                    },
                    defaults={"every": "500ms"},
                )
            )
            made.start(len(made.gateways))
        stack.callback(made.end)
        yield made


async def wait(done: Callable[[], bool], within: float) -> None:
    """Waits until it is done, but not longer."""
    with suppress(TimeoutError):
        async with asyncio.timeout(within):
            while not done():
                await asyncio.sleep(0.05)


async def run(folder: Path, writes: int, tags: int, seed: int, every: float) -> tuple[World, Found]:
    """Writes so often to each of the tags, with a fault about each `every` seconds."""
    each = writes // tags
    assert each < MOST
    async with world(folder, tags, seed) as made:
        clients = [
            Program(
                *(sys.executable, "-c", CLIENT, made.at_router, f"plant/plc/t{tag}/@set"),
                *(1, each + 1, folder / f"t{tag}.jsonl"),
            )
            for tag in range(tags)
        ]

        def ended() -> bool:
            return not any(client.running for client in clients)

        def goes_on(since: int) -> Callable[[], bool]:
            return lambda: ended() or made.executed() > since

        while not ended():
            await wait(goes_on(made.executed()), GOES_ON)
            await wait(ended, made.chance.uniform(0.2, 2.0) * every)
            if not ended():
                await made.befall()
        for client in clients:
            await asyncio.to_thread(client.ended)
    return made, read(folder, tags)


def read(folder: Path, tags: int) -> Found:
    done: dict[int, list[Done]] = {}
    for line in (folder / "plc.jsonl").read_text().splitlines():
        register, value, at = json.loads(line)
        done.setdefault(register, []).append(Done(value, at))
    asked = {}
    for tag in range(tags):
        lines = (folder / f"t{tag}.jsonl").read_text().splitlines()
        asked[tag] = [
            Asked(value, begun, ended, tuple(answers))
            for value, begun, ended, answers in map(json.loads, lines)
        ]
    return Found(asked, done)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--writes", type=int, default=100_000)
    parser.add_argument("--tags", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=5.0)
    options = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        made, found = asyncio.run(
            run(Path(folder), options.writes, options.tags, options.seed, options.every)
        )
        wrongs = found.wrong()
    print(f"{sum(map(len, found.asked.values()))} writes in {time.monotonic() - begun:.0f} s")
    print(f"answers: {dict(found.outcomes())}")
    print(f"executed: {sum(map(len, found.done.values()))}; faults: {dict(made.faults)}")
    print("\n".join(wrongs) or "no write was lost, done twice or told wrongly")
    sys.exit(bool(wrongs))


if __name__ == "__main__":
    main()
