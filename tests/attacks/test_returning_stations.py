"""At the running gateway: silent stations return, with another turnaround, or 31 at once."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import monotonic
from typing import Any

from tests.attacks.slave import PATIENCE, Slave, program_on
from tests.attacks.test_false_acknowledgements import is_good
from tests.zenoh_peer import Subscription, ZenohPeer

WORDS = 10
HEALTHY, SILENT, LAST = 1, 2, 32  # stations
UNANSWERED = 4  # requests to each station
OLD = 34.0  # seconds until the last station was read


@dataclass
class Stations(Slave):
    """Many stations on one wire. `slow`: the turnaround of some."""

    silent: set[int] = field(default_factory=set)
    slow: dict[int, float] = field(default_factory=dict)
    heard: list[tuple[float, int]] = field(default_factory=list)  # time, station
    writer: asyncio.StreamWriter | None = None
    news: asyncio.Event = field(default_factory=asyncio.Event)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        await super().serve(reader, writer)

    def _replies(self, request: bytes) -> Sequence[bytes]:
        self.heard.append((monotonic(), request[0]))
        self.news.set()
        self.delay = self.slow.get(request[0], 0.005)
        if request[0] in self.silent:
            return ()
        return (request,) if request[1] == 6 else super()._replies(request)

    async def until(self, happened: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened():
                self.news.clear()
                await self.news.wait()

    def reset(self) -> None:
        assert self.writer is not None
        self.writer.close()

    def asked(self, station: int, since: int) -> int:
        return sum(number == station for _, number in self.heard[since:])


def device(station: int, every: str, **settings: Any) -> dict[str, Any]:
    tags = {f"w{n}": {"address": f"holding:{n}", "type": "uint16"} for n in range(WORDS)}
    tags = {name: {**tag, "every": every} for name, tag in tags.items()}
    return {"protocol": "modbus-rtu", "station": station, "tags": tags, **settings}


def are_good(values: Subscription, number: int) -> bool:
    return list(map(is_good, values.latest().values())) == [True] * number


async def test_a_station_that_returns_is_seen_soon_and_a_write_waits_for_no_silent_one(
    tmp_path: Path,
) -> None:
    """Both at once, on two lines, because they mostly wait."""
    await asyncio.gather(
        _is_seen_soon(tmp_path / "seen"), _write_waits_for_none(tmp_path / "write")
    )


async def _is_seen_soon(folder: Path) -> None:
    """Its turnaround is another one: each probe got its sound reply too late, but each 16th. A
    neighbour needs the wire before a patient probe would end."""
    async with with_a_silent_one(folder, "500ms", "300ms") as (stations, client):
        values = await client.subscribe("plant/b/w0")
        stations.slow[SILENT], since = 0.25, len(stations.heard)
        stations.silent.clear()
        await values.next(is_good)
        assert stations.asked(SILENT, since) < 15
        assert stations.asked(HEALTHY, since) < 20


async def _write_waits_for_none(folder: Path) -> None:
    """It waited for the `reply_timeout` of the probe before it."""
    async with with_a_silent_one(folder, "1s") as (stations, client):
        waits = []
        for value in (b"1", b"2", b"3"):  # a busy machine may be late once
            since = len(stations.heard)
            await stations.until(lambda: stations.asked(SILENT, since))  # noqa: B023
            probed, since = stations.heard[-1][0], len(stations.heard)
            [answer] = await client.get("plant/a/w0/@set", value)
            assert answer.ok, answer.json
            write = next(at for at, number in stations.heard[since:] if number == HEALTHY)
            waits.append(write - probed)
            if waits[-1] < 0.5:
                break
        assert min(waits) < 0.5


@asynccontextmanager
async def with_a_silent_one(
    folder: Path, reply_timeout: str, every: str = "1h"
) -> AsyncIterator[tuple[Stations, ZenohPeer]]:
    """Device `b` has replied before, and is offline."""
    folder.mkdir()
    stations = Stations(lambda n: n < 100)
    timing = {"reply_timeout": reply_timeout, "late_guard": "50ms", "retries": 0}
    devices = {"a": device(HEALTHY, every, **timing), "b": device(SILENT, "300ms", **timing)}
    devices["a"]["tags"]["w0"]["write"] = True
    async with program_on(stations, folder, devices) as (program, client):
        values = await client.subscribe("plant/*/w0")
        await values.until(lambda values: are_good(values, 2))
        stations.silent.add(SILENT)
        await asyncio.to_thread(program.says, "device offline", "device=b")
        yield stations, client


async def test_31_stations_that_return_at_once_are_read_one_after_the_other(
    tmp_path: Path,
) -> None:
    """The line was silent after the first reply of each: the last one was read after 34 s."""
    stations = Stations(lambda n: n < 100)
    timing = {"reply_timeout": "100ms", "late_guard": "50ms", "retries": 0}
    silent = range(SILENT, LAST + 1)
    devices = {f"p{n}": device(n, "1h", **timing) for n in (HEALTHY, *silent)}
    async with program_on(stations, tmp_path, devices) as (_, client):
        values = await client.subscribe("plant/*/w0")
        await values.until(lambda values: are_good(values, LAST))
        since = len(stations.heard)
        stations.silent.update(silent)
        stations.reset()
        # Then replies to resyncs of one length are no longer told apart.
        await stations.until(lambda: min(stations.asked(n, since) for n in silent) >= UNANSWERED)
        begun, since = monotonic(), len(stations.heard)
        stations.silent.clear()
        await values.until(lambda values: are_good(values, LAST))
        took, heard = monotonic() - begun, stations.heard[since:]
    assert took < OLD / 3
    assert len(heard) < 6 * len(silent)
    waits = []
    for number in silent:
        [first, second] = [at for at, asked in heard if asked == number][:2]
        waits.append(second - first)
    assert median(waits) < 0.1
