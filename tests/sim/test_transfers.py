"""A chain of transfers, Vigor to Computer Link to Modbus, on three wires with faults."""

import asyncio
import random
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import orjson
import pytest

from gateway.config import LineConfig, built
from gateway.contract.keys import Keys
from gateway.line.opening import OpenPort
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import OwnWrites
from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.machine import State
from gateway.parts.alarms.part import AlarmPart
from gateway.parts.transfers import Transfers
from gateway.plant.plant import Plant
from gateway.stations.registry import station_of
from gateway.stations.station import Memory, Station
from tests.parts.made import find, parts_of
from tests.sim.bench import Bench
from tests.sim.virtual import now, on_virtual_time

STALE, STEP = 4.0, 0.7  # seconds; the source counts the steps
AGE = STALE + 0.5  # of a value that arrives: its write is on the wire meanwhile
SECONDS, CALM = 90.0, 12.0
SUBSTITUTE = 60_000
FILE: dict[str, Any] = {
    "zenoh": {"prefix": "plant"},
    "defaults": {"every": "300ms", "type": "uint16", "write": True},
    "lines": {
        protocol: {
            "port": "simulator",
            "baudrate": 19200,
            "format": "7E1" if protocol == "vigor" else "8E1",
            "devices": {
                protocol: {
                    "protocol": protocol,
                    "station": 3,
                    "reply_timeout": "200ms",
                    "tags": {"n": {"address": address}},
                }
            },
        }
        for protocol, address in (
            ("vigor", "D10"),
            ("computer-link", "D0020"),
            ("modbus-rtu", "holding:30"),
        )
    },
    "transfers": [
        {"from": "vigor:D10..D11", "to": "computer-link:D0020..D0021", "stale": f"{STALE:g}s"},
        {
            "from": "computer-link/n",
            "to": "modbus-rtu/n",
            "stale": f"{STALE:g}s",
            "if_stale": {"write": SUBSTITUTE},
        },
    ],
}


@dataclass
class Faulty:
    """A PLC with faults, which notes the words that are written to it."""

    inner: Station
    draw: random.Random
    lose: float = 0.0  # share of the requests, and of the replies, that are lost
    mute: bool = False
    written: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._write = self.memory.write
        self.memory.write = self._note  # type: ignore[method-assign]  # it notes

    @property
    def memory(self) -> Memory:
        return self.inner.memory

    @property
    def value(self) -> int:
        return self.written[-1][1]

    def _note(self, area: str, start: int, values: Iterable[int]) -> None:
        units = [*values]
        assert len(set(units)) == 1, "words of two moments were written together"
        self.written.append((now(), units[0]))
        self._write(area, start, units)

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if self.mute or self.draw.random() < self.lose:
            return []
        replies = self.inner.hear(data, at)
        if self.draw.random() < self.lose:
            return []
        if self.draw.random() < self.lose:
            return [reply[: self.draw.randrange(1, len(reply))] for reply in replies]
        return replies


class Chain:
    """The gateway, its three PLCs, and every outcome."""

    def __init__(self, seed: int) -> None:
        self.draw, self.outcomes = random.Random(seed), list[bytes]()
        self.stations: dict[str, Faulty] = {}
        self.benches: dict[str, Bench] = {}
        self.ends: Sequence[dict[str, Any]] = ()  # the rows at the end
        config = built(FILE)
        self.gateway = Plant(config, lambda: int(now() * 1e9), self._open_line)
        keys = Keys("plant", "demo")
        own = OwnWrites(keys, self.gateway, Audit(self.outcomes.append))
        self.transfers = Transfers(self.gateway, own.write, config.transfers)
        self.gateway.subscribe(self.transfers)
        self.gateway.doors.documents.append(self.transfers.documents)
        self.alarms = find(parts_of(self.gateway, "alarms"), AlarmPart)
        source = self.stations["vigor"].memory
        for number in (10, 11):
            source.animate("D", number, lambda at: int(at / STEP))

    def _open_line(self, config: LineConfig) -> OpenPort:
        [device] = config.devices
        station = Faulty(station_of(device.driver), random.Random(self.draw.random()))
        bench = Bench(seed=self.draw.randrange(999))
        self.stations[config.name], self.benches[config.name] = station, bench
        return lambda receiver: bench.open([station], config.wire, receiver)

    @property
    def rows(self) -> Sequence[dict[str, Any]]:
        documents = self.gateway.status()
        return [
            {"name": f"transfer {number}", **documents[f"transfers/{number}"]} for number in (1, 2)
        ]

    async def suffer(self) -> None:
        """Breaks one thing after another, with calm between."""
        until = now() + SECONDS
        while now() < until:
            name = self.draw.choice(sorted(self.stations))
            station, bench = self.stations[name], self.benches[name]
            match self.draw.choice(("lose", "lose", "mute", "vanish")):
                case "lose":
                    station.lose = 0.3
                case "mute":
                    station.mute = True
                case "vanish":
                    bench.vanish()
            await asyncio.sleep(self.draw.choice((0.5, 3.0, 12.0)))
            station.lose, station.mute = 0.0, False
            bench.come_back()
            await asyncio.sleep(self.draw.choice((0.2, 5.0)))


def active(alarms: Alarms) -> list[str]:
    found = alarms.tally.open.items()
    return [key for key, entry in found if entry.status.state is State.ACTIVE]


Held = dict[int, tuple[float, float]]  # by value: since when, and until when the PLC had it


def held(written: Sequence[tuple[float, int]]) -> Held:
    """When a PLC had each value: until the next one is written. It begins with 0."""
    until = [at for at, _ in written[1:]] + [float("inf")]
    found = {value: (at, end) for (at, value), end in zip(written, until, strict=True)}
    return {0: (0.0, written[0][0])} | found


def check_values(written: Sequence[tuple[float, int]], source: Held) -> None:
    """Nothing that the source had not lately, nothing twice, nothing after a newer one.

    After the substitute the value of before it is written again.
    """
    values = [value for _, value in written]
    for (before, one), (after, other) in pairwise(written):
        apart = one == SUBSTITUTE and after - before > STALE  # the source was good between
        assert one != other or apart, f"{one} was written twice, at {before} and {after}"
    known = [value for value in values if value != SUBSTITUTE]
    assert known == sorted(known), "a value was written after a newer one"
    for at, value in written:
        since, until = source.get(value, (0.0, 0.0))
        assert value == SUBSTITUTE or since <= at <= until + AGE, (at, value, since, until)


@pytest.mark.parametrize("seed", range(2))
def test_a_chain_carries_nothing_bad_nothing_old_and_nothing_twice(seed: int) -> None:
    chains: list[Chain] = []

    @on_virtual_time
    async def story() -> None:
        chain = Chain(seed)
        chains.append(chain)
        gateway = chain.gateway
        tasks = [asyncio.create_task(line.run()) for line in gateway.lines]
        chain.transfers.start()
        watch = asyncio.create_task(chain.alarms.run())
        await chain.suffer()
        await asyncio.sleep(CALM)
        # All is well again: both rows carry, and say so.
        assert [row["state"] for row in chain.rows] == ["carried", "carried"]
        assert [row["code"] for row in chain.rows] == ["0", "0"]
        assert now() / STEP - chain.stations["modbus-rtu"].value < 2 / STEP
        assert not {"transfer:1", "transfer:2"} & set(active(chain.alarms.alarms))
        # The first PLC is silent: both say why, and the last PLC gets the substitute once.
        chain.stations["vigor"].mute = True
        await asyncio.sleep(CALM)
        first, second = chain.rows
        assert first["state"] == "stale"
        assert first["code"] in ("A", "B")  # B: the line tries to open its port again
        assert (second["state"], second["code"]) == ("carried", "0")  # it is read and good
        chain.stations["computer-link"].mute = True
        await asyncio.sleep(CALM)
        assert [row["state"] for row in chain.rows] == ["stale", "stale"]
        assert chain.stations["modbus-rtu"].value == SUBSTITUTE
        assert {"transfer:1", "transfer:2"} <= set(active(chain.alarms.alarms))
        # The target is silent: nothing is sent until it replies.
        chain.stations["vigor"].mute = False
        await asyncio.sleep(CALM)
        first = chain.rows[0]
        assert (first["state"], first["code"]) == ("waiting", "A")
        chain.stations["computer-link"].mute = False
        await asyncio.sleep(CALM)
        assert [row["state"] for row in chain.rows] == ["carried", "carried"]
        chain.ends = chain.rows
        await chain.transfers.stop()
        for task in (*tasks, watch):
            task.cancel()
        await asyncio.gather(*tasks, watch, return_exceptions=True)

    story()
    [chain] = chains
    middle, last = (chain.stations[name].written for name in ("computer-link", "modbus-rtu"))
    count = range(1000, 3000)
    check_values(middle, {value: (value * STEP, (value + 1) * STEP) for value in count})
    check_values(last, held(middle))
    assert SUBSTITUTE in [value for _, value in last]
    for row, written in zip(chain.ends, (middle, last), strict=True):
        mine = [one for one in map(orjson.loads, chain.outcomes) if one["by"] == row["name"]]
        ends = Counter(one["outcome"] for one in mine)  # a write may be under way at the end
        assert ends["written"] <= len(written) <= ends["written"] + ends["unclear"]
        assert (ends["written"], row["refused"]) == (row["carried"], 0)
        assert 0 <= ends["unclear"] - row["unclear"] <= 1
        assert row["carried"] > 50
    assert chain.ends[0]["not_done"] > 0
    assert sum(row["unclear"] for row in chain.ends) > 0
    assert all(b'"by":"transfer ' in outcome for outcome in chain.outcomes)
