"""A plant of many gateways and routers, some of them killed: `python -m benchmarks.plant`.

Ten gateways with 10,000 tags each, three routers in a ring, a consumer that checks every value
(`plant_consumer`), and `examples/catch_up.py`, each in a process of its own. A gateway and a
consumer are clients of one router, and know a second one. It prints the time of the start, the
steady state, and what the consumer saw when a router, the consumer's router, a gateway, and the
active gateway of a standby pair were killed. `python -m benchmarks.plant --help` has the sizes.
"""

import argparse
import asyncio
import json
import os
import signal
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, Self

from tests.e2e.processes import ROOT, Program, gateway
from tests.zenoh_peer import ZenohPeer, free_endpoint

PATIENCE = 300.0  # seconds for anything
RESTART = 1.0  # seconds from the end of a gateway to its next start, as a service manager waits
MB = 1e6


class Sizes(NamedTuple):
    """A plant: gateways, routers; lines of a gateway, devices of a line, tags of a device."""

    gateways: int = 10
    routers: int = 3
    lines: int = 4
    devices: int = 25
    tags: int = 100
    every: float = 30.0  # seconds

    @property
    def of_gateway(self) -> int:
        return self.lines * self.devices * self.tags


class Used(NamedTuple):
    """Seconds of the processor, bytes of memory."""

    processor: float
    memory: float


def used(pid: int) -> Used:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    processor = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return Used(processor, int(fields[21]) * os.sysconf("SC_PAGE_SIZE"))


@dataclass
class Consumer:
    """The process of `plant_consumer`. `live`: its file."""

    process: asyncio.subprocess.Process
    live: Path

    async def report(self) -> dict[str, Any]:
        """Returns what happened since the last report."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(b"\n")
        found: dict[str, Any] = json.loads(await self.process.stdout.readline())
        return found


@dataclass
class Plant:
    """The processes of the plant. An async context manager."""

    sizes: Sizes
    folder: Path
    endpoints: list[str] = field(default_factory=list)
    routers: list[ZenohPeer] = field(default_factory=list)
    gateways: dict[str, Program] = field(default_factory=dict)
    _stack: AsyncExitStack = field(default_factory=AsyncExitStack)

    async def __aenter__(self) -> Self:
        self.endpoints = [free_endpoint() for _ in range(self.sizes.routers)]
        for place in range(self.sizes.routers):
            self.routers.append(await self._router(place))
        return self

    async def __aexit__(self, *error: object) -> None:
        for program in self.gateways.values():
            if program.running:
                program.end()
        await self._stack.aclose()

    async def _router(self, place: int) -> ZenohPeer:
        """Starts a router that connects to the others; they connect to it again by themselves."""
        others = [endpoint for endpoint in self.endpoints if endpoint != self.endpoints[place]]
        router = ZenohPeer("router", [self.endpoints[place]], others, {"connect/timeout_ms": 0})
        return await self._stack.enter_async_context(router)

    async def kill_router(self, place: int) -> None:
        await self.routers[place].kill()

    async def restart_router(self, place: int) -> None:
        self.routers[place] = await self._router(place)

    def near(self, place: int) -> list[str]:
        """Returns the endpoints of a router and of the next one."""
        return [self.endpoints[(place + n) % self.sizes.routers] for n in range(2)]

    def start_gateway(
        self, name: str, place: int, *, standby: bool = False, mode: str = "client"
    ) -> None:
        """Starts it, also again. `name` is `g<n>`, and `g<n>-spare` for the spare of a pair."""
        path = self.folder / f"{name}.yaml"
        if not path.exists():
            path.write_text("\n".join(self._rows(name, place, mode, standby=standby)) + "\n")
        self.gateways[name] = self._stack.enter_context(gateway("run", path))

    def _rows(self, name: str, place: int, mode: str, *, standby: bool) -> list[str]:
        sizes, plain = self.sizes, name.partition("-")[0]
        group = f", standby: {plain}" if standby else ""
        connect = ", ".join(self.near(place))
        defaults = f"every: {sizes.every}s, publish: always, history: true, type: uint16"
        # A patient time-out: the simulated PLCs are slow while the machine is overloaded.
        vigor = "protocol: vigor, reply_timeout: 2s"
        rows = [
            f"gateway: {{name: {name}{group}}}",
            f"zenoh: {{mode: {mode}, listen: [], connect: [{connect}]}}",
            f"history: {{path: {name}.db}}",
            f"defaults: {{{defaults}}}",
            "lines:",
        ]
        for line in range(sizes.lines):
            rows.append(f"  line{line}: {{port: simulator, baudrate: 19200, devices: {{")
            for device in range(sizes.devices):
                tags = ", ".join(f"t{n}: {{address: D{n}}}" for n in range(sizes.tags))
                rows.append(f"    {plain}-{line}-{device}: {{{vigor}, "
                            f"station: {device + 1}, tags: {{{tags}}}}},")  # fmt: skip
            rows.append("  }}")
        return rows

    async def consumer(self, place: int) -> Consumer:
        live = self.folder / "live.txt"
        arguments = ["plant", str(live), *self.near(place)]
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "benchmarks.plant_consumer", *arguments),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=64 * 1024 * 1024,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        self._stack.push_async_callback(process.wait)
        self._stack.callback(process.stdin.close)
        await process.stdout.readline()
        return Consumer(process, live)

    async def catch_up(self, place: int) -> asyncio.subprocess.Process:
        """Starts the example; its output is `caught.txt`."""
        since = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        example = ROOT / "examples" / "catch_up.py"
        with (self.folder / "caught.txt").open("wb") as file:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, str(example), "--connect", *self.near(place), "--since", since),
                stdout=file,
            )

        async def end() -> None:
            if process.returncode is None:
                process.terminate()
            await process.wait()

        self._stack.push_async_callback(end)
        return process

    def recorded(self) -> set[str]:
        """Returns time and key of all samples in the files of history."""
        found = set[str]()
        for path in self.folder.glob("*.db"):
            with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as base:
                for key, nanoseconds in base.execute("SELECT key, time FROM history"):
                    found.add(f"{utc(nanoseconds)} plant/{key}")
        return found


def utc(nanoseconds: int) -> str:
    seconds, rest = divmod(nanoseconds, 10**9)
    return f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(seconds))}.{rest // 1000:06}Z"


def rows_of(path: Path) -> list[str]:
    """Returns time and key of each complete line."""
    return [" ".join(line.split()[:2]) for line in path.read_text().splitlines(keepends=True)
            if line.endswith("\n")]  # fmt: skip


class Seen(NamedTuple):
    """Reports of the consumer, joined into one."""

    reports: list[dict[str, Any]]

    def counted(self, what: str) -> int:
        return sum(report["counts"].get(what, 0) for report in self.reports)

    def arrived(self) -> int:
        return sum(known["arrived"] for r in self.reports for known in r["gateways"].values())

    def of(self, name: str, field: str) -> list[Any]:
        return [r["gateways"][name][field] for r in self.reports if name in r["gateways"]]

    def numbers(self, name: str, field: str) -> list[tuple[float, int]]:
        """Returns when the number changed. `field`: `devices` or `shown`."""
        return [tuple(change) for changes in self.of(name, field) for change in changes]

    def longest_gap(self, names: Iterable[str]) -> float:
        return float(max(max(self.of(name, "longest_gap")) for name in names))

    @property
    def late(self) -> tuple[float, float, float]:
        """Returns the usual median of a report, the largest 99th percentile, the largest of all."""
        median, most, longest = zip(*(r["late"] for r in self.reports), strict=True)
        return sorted(median)[len(median) // 2], max(most), max(longest)

    @property
    def oldest(self) -> float:
        return float(max(report["oldest"] for report in self.reports))


async def watch(
    consumer: Consumer,
    sizes: Sizes,
    names: Sequence[str],
    least: float = 0.0,
    until: Callable[[Seen], bool] = lambda _: True,
) -> Seen:
    """Collects reports for `least` seconds, and until the values of all gateways are shown."""
    reports, begun = list[dict[str, Any]](), time.monotonic()
    while True:
        await asyncio.sleep(0.5)
        reports.append(await consumer.report())
        seen, past = Seen(reports), time.monotonic() - begun
        shown = {name: (seen.numbers(name, "shown") or [(0.0, 0)])[-1][1] for name in names}
        whole = all(number == sizes.of_gateway for number in shown.values())
        if past >= least and whole and until(seen):
            return seen
        if past > PATIENCE:
            raise SystemExit(f"values are missing after {past:.0f} s: {shown}")


class Event(NamedTuple):
    """Seconds after a kill, as the consumer saw them; None: it did not happen."""

    what: str
    offline: float | None  # the last device of the gateways went offline
    online: float | None  # the last of them was back
    gap: float  # the longest time without any value of one of the gateways
    unknown: int  # the most values that were not shown at one time
    whole: float | None  # all values were shown again
    seen: Seen


def event(what: str, killed: float, names: Sequence[str], sizes: Sizes, seen: Seen) -> Event:
    """`names`: the gateways that were killed or cut, as in keys."""
    devices = [change for name in names for change in seen.numbers(name, "devices")]
    shown = {name: seen.numbers(name, "shown") for name in names}
    gone = [at for at, number in devices if at > killed and number == 0]
    back = [at for at, number in devices if at > killed and number == sizes.lines * sizes.devices]
    full = [at for changes in shown.values() for at, number in changes
            if at > killed and number == sizes.of_gateway]  # fmt: skip
    least = sum(min(number for _, number in changes) for changes in shown.values())
    return Event(
        what,
        max(gone) - killed if gone else None,
        max(back) - killed if gone and back else None,
        seen.longest_gap(names),
        len(names) * sizes.of_gateway - least,
        max(full) - killed if full else None,
        seen,
    )


@dataclass
class Result:
    """All that is printed."""

    start: dict[str, float] = field(default_factory=dict)
    steady: Seen = field(default_factory=lambda: Seen([]))
    seconds: float = 0.0
    use: dict[str, list[Used]] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    recorded: int = 0
    live: int = 0
    caught: int = 0
    caught_twice: int = 0


async def run(sizes: Sizes, folder: Path, steady: float, settle: float, patience: float) -> Result:
    """Starts the plant and kills parts of it. `settle`: the least seconds watched after a kill;
    `patience`: the most seconds for `catch_up.py` at the end."""
    result, names = Result(), [f"g{n}" for n in range(sizes.gateways)]
    pair = names[-1]
    async with Plant(sizes, folder) as plant:
        consumer = await plant.consumer(sizes.routers - 1)
        catcher = await plant.catch_up(sizes.routers - 1)
        begun = time.monotonic()
        for place, name in enumerate(names):
            plant.start_gateway(name, place, standby=name == pair)
        plant.start_gateway(f"{pair}-spare", len(names), standby=True)
        seen = await watch(consumer, sizes, names)
        result.start = milestones(seen, names, begun)

        pids = {
            "a gateway": [plant.gateways[name].pid for name in names],
            "the spare gateway": [plant.gateways[f"{pair}-spare"].pid],
            "a router": [router.pid for router in plant.routers],
            "the consumer": [consumer.process.pid],
            "catch_up.py": [catcher.pid],
        }
        before = {name: [used(pid) for pid in of] for name, of in pids.items()}
        await consumer.report()
        since = time.monotonic()
        result.steady = await watch(consumer, sizes, names, steady)
        result.seconds = time.monotonic() - since
        for name, of in pids.items():
            changes = zip(of, before[name], strict=True)
            result.use[name] = [
                Used((now := used(pid)).processor - old.processor, now.memory)
                for pid, old in changes
            ]

        async def after(what: str, killed: float, cut: Sequence[str]) -> None:
            seen = await watch(consumer, sizes, names, settle)
            result.events.append(event(what, killed, cut, sizes, seen))

        cut = [name for place, name in enumerate(names) if place % sizes.routers == 0]
        await plant.kill_router(0)
        await after(f"router of {len(cut)} gateways", time.monotonic(), cut)
        await plant.restart_router(0)
        await after("it returned", time.monotonic(), cut)
        await plant.kill_router(sizes.routers - 1)
        await after("router of the consumer", time.monotonic(), names)
        await plant.restart_router(sizes.routers - 1)
        await after("it returned", time.monotonic(), names)

        killed = time.monotonic()
        await asyncio.to_thread(plant.gateways[names[0]].end, signal.SIGKILL)
        await asyncio.sleep(RESTART)
        plant.start_gateway(names[0], 0)
        await after(f"gateway, started again after {RESTART:g} s", killed, names[:1])
        killed = time.monotonic()
        active = pair if plant.gateways[pair].has_said("device online") else f"{pair}-spare"
        await asyncio.to_thread(plant.gateways[active].end, signal.SIGKILL)
        await after("active gateway of a pair", killed, [pair])

        for program in plant.gateways.values():
            assert not program.has_said("Traceback"), program.lines
        await all_caught(plant, result, consumer, patience)
    return result


def milestones(seen: Seen, names: Sequence[str], begun: float) -> dict[str, float]:
    """Returns the seconds from the start of the processes."""

    def when(names: Sequence[str], field: str) -> float:
        return max(seen.numbers(name, field)[-1][0] for name in names) - begun

    *single, pair = names
    return {
        "all devices of single gateways are online": when(single, "devices"),
        "all values of single gateways are good": when(single, "shown"),
        "all values of the pair are good": when([pair], "shown"),
    }


async def all_caught(plant: Plant, result: Result, consumer: Consumer, within: float) -> None:
    """Ends the gateways, so that the files are complete, and compares them with the consumers.

    `catch_up.py` gets time for one more check first: of what was recorded until now.
    """
    until = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    recorded = {row for row in plant.recorded() if row < until}
    patience = time.monotonic() + within
    while True:
        rows = rows_of(plant.folder / "caught.txt")
        caught = set(rows)
        if recorded <= caught or time.monotonic() > patience:
            break
        await asyncio.sleep(1.0)
    await consumer.report()  # its file is complete up to now
    live = set(rows_of(consumer.live))
    result.recorded = len(recorded)
    result.live, result.caught = len(recorded & live), len(recorded & caught)
    result.caught_twice = len(rows) - len(caught)


def seconds(found: float | None) -> str:
    return "-" if found is None else f"{found:.2f} s"


def shown(result: Result, sizes: Sizes) -> Iterator[str]:
    """Yields the tables of docs/scale.md."""
    yield "\n| start | seconds |\n|---|---|"
    yield from (f"| {what} | {found:.1f} |" for what, found in result.start.items())
    steady = result.steady
    rate = steady.arrived() / result.seconds
    yield f"\nSteady state, {result.seconds:.0f} s: {rate:,.0f} values/s"
    median, most, longest = steady.late
    yield (f"late at the consumer: usually {median * 1e3:.0f} ms, 99th percentile at most "
           f"{most * 1e3:.0f} ms, longest {longest * 1e3:.0f} ms; oldest shown value "
           f"{steady.oldest:.1f} s")  # fmt: skip
    yield "\n| process | number | % of a core, each | memory, MB each |\n|---|---|---|---|"
    for name, of in result.use.items():
        processor = sum(one.processor for one in of) / len(of) / result.seconds
        memory = sum(one.memory for one in of) / len(of) / MB
        yield f"| {name} | {len(of)} | {processor:.1%} | {memory:.0f} |"
    yield "\n| killed | offline | online | longest gap | unknown | all shown | oldest shown |"
    yield "|---|---|---|---|---|---|---|"
    for one in result.events:
        yield (f"| {one.what} | {seconds(one.offline)} | {seconds(one.online)} | {one.gap:.2f} s "
               f"| {one.unknown:,} | {seconds(one.whole)} | {one.seen.oldest:.1f} s |")  # fmt: skip
    whole = Seen([report for one in result.events for report in one.seen.reports])
    yield (f"\nwrong values shown as good: {whole.counted('wrong') + steady.counted('wrong')}; "
           f"values older than the one before: {whole.counted('older')}; "
           f"bad values: {whole.counted('bad')}; sent again: {whole.counted('again')}")  # fmt: skip
    yield (f"recorded: {result.recorded:,}; received live: {result.live:,}; "
           f"by catch_up.py: {result.caught:,}, twice: {result.caught_twice}")  # fmt: skip
    yield f"{sizes.gateways} gateways, {sizes.gateways * sizes.of_gateway:,} tags"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=Sizes().gateways)
    parser.add_argument("--routers", type=int, default=Sizes().routers)
    parser.add_argument("--lines", type=int, default=Sizes().lines, help="of a gateway")
    parser.add_argument("--devices", type=int, default=Sizes().devices, help="of a line")
    parser.add_argument("--tags", type=int, default=Sizes().tags, help="of a device")
    parser.add_argument("--every", type=float, default=Sizes().every, help="seconds")
    parser.add_argument("--steady", type=float, default=60.0, help="seconds")
    parser.add_argument("--settle", type=float, default=25.0, help="seconds after each kill")
    parser.add_argument("--patience", type=float, default=PATIENCE, help="for catch_up.py")
    given = parser.parse_args()
    sizes = Sizes(
        given.gateways, given.routers, given.lines, given.devices, given.tags, given.every
    )
    with tempfile.TemporaryDirectory() as folder:
        result = asyncio.run(run(sizes, Path(folder), given.steady, given.settle, given.patience))
    print("\n".join(shown(result, sizes)))


if __name__ == "__main__":
    main()
