"""Speed of samples from the mirror to a subscriber, compared with a bare loop of puts.

    python -m benchmarks.northbound [--tags 50000] [--devices 10 100 1000] [--seconds 5] [--flood 5]

The subscriber is another process on the same machine. One run measures, for each number of devices:

* a bare loop of `session.put` with one fixed payload of the same size, in a session without a
  gateway: the best that Python can do here; and again with the declarations of a gateway;
* the same number of samples through `Mirror.update` and `Northbound.publish` until all have
  arrived, and the delay of the event loop;
* the same for devices with `blocks: only`: one put for all 500 tags of a device;
* the time from the configuration to the first publishing, and memory;
* with `--flood`: for so many seconds queries as fast as three processes can send them, then for
  the same time queries, writes and junk on every key from two. It prints the delay of the event
  loop, the growth of memory, and the ends of the queries.
"""

import argparse
import asyncio
import gc
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import structlog
import zenoh

from benchmarks.northbound_clients import Lag
from gateway.config import ZenohConfig
from gateway.engine.jobs.requests import CommandResult, Peeked
from gateway.errors import GatewayError
from gateway.line.send_permit import SendPermit
from gateway.line.wire_log import WireLog
from gateway.northbound.northbound import Northbound
from gateway.northbound.session.session_settings import configure
from gateway.parts.alarms.board import Alarms
from gateway.protocols.driver import Address, Span, Unit
from gateway.service.service import GC_THRESHOLDS, THREAD_SWITCH
from gateway.tags import Sample, Tag, WriteResult, WriteRule, good
from gateway.tags.mirror import Mirror
from gateway.values import Layout, Value, parse_type
from tests.no_parts import STATUS, NoParts
from tests.northbound.plant import running
from tests.zenoh_peer import free_endpoint

SCAN = 100  # samples of one publication


@dataclass
class Device:
    name: str
    tags: list[Tag]
    blocks: bool | Literal["only"] = False
    control: bool = False
    templates: tuple[str, ...] = ()


@dataclass
class Plant:
    """Devices whose samples are those of a mirror."""

    made: list[Device]
    mirror: Mirror = field(init=False)
    alarms: Alarms = field(init=False)
    duty: SendPermit = field(default_factory=SendPermit)

    def __post_init__(self) -> None:
        self.tags = [tag for device in self.made for tag in device.tags]
        self.mirror = Mirror(self.tags, time.time_ns())
        self.alarms = Alarms(self.tags)
        self._by_key = {tag.key: tag for tag in self.tags}

    def devices(self) -> list[Device]:
        return self.made

    def wire_logs(self) -> dict[str, WireLog]:
        return {}

    def begin(self) -> None:
        pass

    def tag(self, key: str) -> Tag | None:
        return self._by_key.get(key)

    def sample(self, tag: Tag) -> Sample:
        return self.mirror[tag]

    async def write_group(
        self, values: Sequence[tuple[Tag, Value]], within: float, patience: float
    ) -> Sequence[WriteResult | GatewayError]:
        for tag, value in values:
            tag.encode(value)
        return [WriteResult(value, time.time_ns(), took=0.0) for _, value in values]

    def mark_published(self, samples: Sequence[Sample]) -> None:
        self.mirror.mark_published(samples)

    def commands(self) -> Mapping[str, frozenset[str]]:
        return {}

    def speaker(self, line: str) -> str:
        raise NotImplementedError

    async def control(
        self, device: str, command: str, argument: str, within: float
    ) -> CommandResult:
        raise NotImplementedError

    async def peek(self, device: str, text: str) -> Peeked:
        raise NotImplementedError

    def dialling(self, device: str) -> float:
        return 0.0

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        return False

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        return self.mirror[tag]

    def status(self) -> Mapping[str, Mapping[str, object]]:
        return {"status": STATUS}


def plant(tags: int, devices: int, blocks: bool | Literal["only"] = False) -> Plant:
    layout = Layout(parse_type("int32"))
    address, span = Address("D", 100), Span("D", 100, 2)

    def tag(device: int, number: int) -> Tag:
        return Tag(
            device=f"d{device}",
            name=f"t{number}",
            text="D100",
            address=address,
            span=span,
            unit_kind=Unit.WORD,
            layout=layout,
            write=WriteRule() if number == 0 else None,
        )

    each = tags // devices
    return Plant(
        [Device(f"d{d}", [tag(d, n) for n in range(each)], blocks) for d in range(devices)]
    )


def memory() -> float:
    """MB in use by this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@contextmanager
def other(*arguments: object) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "benchmarks.northbound_clients", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(20)


class Arrived(NamedTuple):
    samples: int
    seconds: float  # of processor time, all threads

    def __sub__(self, other: "Arrived") -> "Arrived":
        return Arrived(self.samples - other.samples, self.seconds - other.seconds)


class Counter:
    """The subscriber's count."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"

    def now(self) -> Arrived:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        samples, seconds = self._process.stdout.readline().split()
        return Arrived(int(samples), float(seconds))

    def until_quiet(self) -> Arrived:
        before = -1
        while (found := self.now()).samples != before:
            before = found.samples
            time.sleep(0.3)
        return found


# -- measured ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rate:
    put: int
    took: float  # seconds
    ours: float  # seconds of processor time
    arrived: Arrived

    @property
    def each(self) -> float:
        """Samples that arrived, a second."""
        return self.arrived.samples / self.took

    def __str__(self) -> str:
        samples, theirs = self.arrived
        return (f"{self.put / self.took:,.0f}/s put, {samples / self.put:.1%} of them arrived; "
                f"processor time of a sample {self.ours / self.put * 1e6:.1f} us here, "
                f"{theirs / max(samples, 1) * 1e6:.1f} us at the subscriber")  # fmt: skip


def bare(tags: int, devices: int, seconds: float, *, like_ours: bool) -> Rate:
    """A loop of puts, as many as arrive: `session.put(key, payload)` and nothing else; or
    `like_ours`, beside the tokens and queryables of a gateway, against which Zenoh matches each
    put, and with encoding, time stamp and `DROP`."""
    endpoint = free_endpoint()
    keys = [f"plant/d{d}/t{n}" for d in range(devices) for n in range(tags // devices)]
    data = b'{"value":123456,"quality":"good","time":"2026-11-20T12:00:00.123456Z"}'
    json_encoding, drop = zenoh.Encoding.APPLICATION_JSON, zenoh.CongestionControl.DROP
    with (
        zenoh.open(configure(ZenohConfig(listen=(endpoint,)))) as session,
        other("count", endpoint) as process,
    ):
        put, stamp = session.put, session.new_timestamp
        kept: list[object] = []
        if like_ours:
            ignore: zenoh.handlers.Callback[zenoh.Query] = zenoh.handlers.Callback(
                lambda _: None, indirect=False
            )
            for device in range(devices):
                key = f"plant/@gateway/demo/alive/d{device}"
                kept.append(session.liveliness().declare_token(key))
            kept.append(session.declare_queryable("plant/**/@set", ignore))
        counter = Counter(process)
        time.sleep(0.3)
        first, used = counter.now(), time.process_time()
        began, count = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            if like_ours:
                for key in keys:
                    put(key, data, encoding=json_encoding, congestion_control=drop,
                        timestamp=stamp())  # fmt: skip
            else:
                for key in keys:
                    put(key, data)
            count += len(keys)
        took, used = time.perf_counter() - began, time.process_time() - used
        rate = Rate(count, took, used, counter.until_quiet() - first)
    beside = f"beside {len(kept)} declarations" if kept else "and nothing else"
    print(f"bare loop of put {beside}: {rate}")
    return rate


async def gateway(tags: int, devices: int, seconds: float, for_flood: float) -> Rate:
    sys.setswitchinterval(THREAD_SWITCH)  # both as the service does
    gc.set_threshold(*GC_THRESHOLDS)
    endpoint = free_endpoint()
    before = memory()
    made = plant(tags, devices)
    with_tags = memory()
    began = time.perf_counter()
    northbound = Northbound(ZenohConfig(listen=(endpoint,)), "demo", made, parts=NoParts())
    async with running(northbound):
        print(f"on Zenoh with {tags:,} tags on {devices} devices after "
              f"{time.perf_counter() - began:.2f} s")  # fmt: skip
        print(f"memory: {before:.0f} MB empty, {with_tags - before:.0f} MB more with the tags, "
              f"{memory() - with_tags:.0f} MB more on Zenoh")  # fmt: skip
        for device in made.made:
            northbound.set_online(device.name, True)
        with other("count", endpoint) as process:
            counter = await asyncio.to_thread(Counter, process)
            await asyncio.sleep(1.0)
            rate = await published(made, northbound, counter, seconds)
        if for_flood:
            await flooded(made, northbound, ("ask", "ask", "ask"), endpoint, for_flood)
            await flooded(made, northbound, ("flood", "ask"), endpoint, for_flood)
    return rate


async def gateway_of_blocks(tags: int, devices: int, seconds: float) -> Rate:
    """Each device has one scan in a round; the next round begins when all were put."""
    endpoint, made = free_endpoint(), plant(tags, devices, "only")
    northbound = Northbound(ZenohConfig(listen=(endpoint,)), "demo", made, parts=NoParts())
    async with running(northbound):
        with other("count", endpoint) as process:
            counter = await asyncio.to_thread(Counter, process)
            await asyncio.sleep(1.0)
            first = await asyncio.to_thread(counter.until_quiet)
            lag = Lag()
            probe = asyncio.create_task(lag.run())
            began, used, sent = time.perf_counter(), time.process_time(), 0
            while time.perf_counter() - began < seconds:
                before = northbound.counters()["published"]
                sent += await publish_all(made, northbound, tags // devices)
                await put(northbound, before + devices)
            took, used = time.perf_counter() - began, time.process_time() - used
            probe.cancel()
            rate = Rate(sent, took, used, await asyncio.to_thread(counter.until_quiet) - first)
            print(f"gateway, blocks: only: {rate}; {lag.shown()}")
    return rate


async def published(made: Plant, northbound: Northbound, counter: Counter, seconds: float) -> Rate:
    for _ in range(2):
        before = northbound.counters()["published"]
        await put(northbound, before + await publish_all(made, northbound))
    first = await asyncio.to_thread(counter.until_quiet)
    gc.collect()
    gc.freeze()  # as the service does once it runs
    lag = Lag()
    probe = asyncio.create_task(lag.run())
    began, used, sent = time.perf_counter(), time.process_time(), 0
    before = northbound.counters()["published"]
    while time.perf_counter() - began < seconds:
        sent += await publish_all(made, northbound)
        await put(northbound, before + sent - SCAN)  # as lines go on; and nothing is replaced
    await put(northbound, before + sent)
    took, used = time.perf_counter() - began, time.process_time() - used
    probe.cancel()
    rate = Rate(sent, took, used, await asyncio.to_thread(counter.until_quiet) - first)
    print(f"gateway, from mirror to put: {rate}; {lag.shown()}; memory {memory():.0f} MB")
    return rate


async def put(northbound: Northbound, count: int) -> None:
    """Until so many were put."""
    while northbound.counters()["published"] < count:
        await asyncio.sleep(0.002)


async def publish_all(made: Plant, northbound: Northbound, scan: int = SCAN) -> int:
    """New values of all tags, a scan at a time; how many samples went out."""
    sent, now = 0, time.time_ns()
    for start in range(0, len(made.tags), scan):
        samples = [
            good(tag, now % 1_000_003 + start, now) for tag in made.tags[start : start + scan]
        ]
        news = made.mirror.update(samples)
        northbound.publish(news)
        sent += len(news)
        await asyncio.sleep(0)
    return sent


async def flooded(
    made: Plant, northbound: Northbound, kinds: Sequence[str], endpoint: str, seconds: float
) -> None:
    """By a process for each kind: `ask`, or `flood` with everything."""
    lag = Lag()
    probe = asyncio.create_task(lag.run())
    before, most, earlier = memory(), memory(), northbound.counters()
    with ExitStack() as stack:
        strangers = [stack.enter_context(other(kind, endpoint, seconds)) for kind in kinds]
        while any(stranger.poll() is None for stranger in strangers):
            samples = [good(tag, 1, time.time_ns()) for tag in made.tags[:SCAN]]
            northbound.publish(made.mirror.update(samples))
            most = max(most, memory())
            await asyncio.sleep(0.1)
        reports = [stranger.stdout.read().strip() for stranger in strangers if stranger.stdout]
    probe.cancel()
    print(f"{seconds:g} s of {' + '.join(kinds)}: {lag.shown()}; "
          f"memory {before:.0f} MB, at most {most:.0f} MB")  # fmt: skip
    print("the clients reported:", *reports)
    now = northbound.counters()
    print("counted:", {name: now[name] - earlier.get(name, 0) for name in now})


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tags", type=int, default=50_000)
    parser.add_argument("--devices", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--flood", type=float, default=0.0)
    options = parser.parse_args(arguments)
    structlog.configure(processors=[_quiet])
    with other("idle", options.seconds) as process:
        assert process.stdout is not None
        late = json.loads(process.stdout.readline())
        print(f"an idle event loop here is late: p99 {late[int(len(late) * 0.99)] * 1e3:.2f} ms")
    rates = {
        devices: compared(options.tags, devices, options.seconds, options.flood)
        for devices in options.devices
    }
    for devices, (rate, share) in rates.items():
        print(f"{devices} devices: {rate.each:,.0f}/s arrived, {share:.2f} of the bare loop, "
              f"{rate.ours / rate.put * 1e6:.1f} us here")  # fmt: skip


def compared(tags: int, devices: int, seconds: float, for_flood: float) -> tuple[Rate, float]:
    """The gateway, and its share of the bare loop just before and after it."""
    load = tags, devices, seconds
    best = bare(*load, like_ours=False)
    rate = asyncio.run(gateway(*load, for_flood))
    blocks = asyncio.run(gateway_of_blocks(*load))
    again = bare(*load, like_ours=False)
    like = bare(*load, like_ours=True)
    most = max(best.each, again.each)
    print(f"arrived: {rate.each:,.0f}/s; {rate.each / most:.2f} of the bare loop with nothing "
          f"else, {rate.each / like.each:.2f} of the one like ours; "
          f"in blocks {blocks.each:,.0f}/s, {blocks.each / most:.2f}")  # fmt: skip
    return rate, rate.each / most


def _quiet(*_: object) -> str:
    raise structlog.DropEvent


if __name__ == "__main__":
    main()
