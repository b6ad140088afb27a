"""How fast samples go from the mirror to a subscriber, beside a bare loop of puts.

    python -m benchmarks.northbound [--tags 50000] [--devices 100] [--seconds 5] [--flood 5]

The subscriber is a process of its own on the same machine. Measured in one run:

* a bare loop of `session.put` with one fixed payload of the same size, in a session without a
  gateway: the best that Python can do here; and again with the declarations of a gateway;
* the same number of samples through `Mirror.update` and `Northbound.publish`: decided, made
  into JSON and put, all of them arrived, and how late the event loop was meanwhile;
* the time from a made configuration to being on Zenoh, and memory;
* with `--flood`: questions, writes and junk on every key from another process for so many
  seconds: how late the event loop was, and what memory grew by.
"""

import argparse
import asyncio
import gc
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import structlog
import zenoh

from gateway.mirror import Mirror
from gateway.northbound import Mode, Northbound, ZenohSettings
from gateway.northbound.session import configure
from gateway.protocols.driver import Address, Span, Unit
from gateway.service import SWITCH
from gateway.tags import Sample, Tag, WriteRule, Written, good
from gateway.values import Layout, Value, parse_type
from tests.zenoh_peer import free_endpoint

SCAN = 100  # samples of one publication


@dataclass
class Device:
    name: str
    tags: list[Tag]
    blocks: bool = False


@dataclass
class Plant:
    """Devices whose samples are those of a mirror."""

    made: list[Device]
    mirror: Mirror = field(init=False)

    def __post_init__(self) -> None:
        self.tags = [tag for device in self.made for tag in device.tags]
        self.mirror = Mirror(self.tags, time.time_ns())

    def devices(self) -> list[Device]:
        return self.made

    def tag(self, key: str) -> Tag | None:
        return next((tag for tag in self.tags if tag.key == key), None)

    def sample(self, tag: Tag) -> Sample:
        return self.mirror[tag]

    async def write(self, tag: Tag, value: Value) -> Written:
        tag.encode(value)
        return Written(value, time.time_ns(), took=0.0)

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        return self.mirror[tag]

    def status(self) -> Mapping[str, Mapping[str, object]]:
        return {"status": {"state": "running"}}


def plant(tags: int, devices: int) -> Plant:
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
    return Plant([Device(f"d{d}", [tag(d, n) for n in range(each)]) for d in range(devices)])


class Lag:
    """How late the event loop was, probed every 2 ms."""

    def __init__(self) -> None:
        self.late: list[float] = []

    async def run(self) -> None:
        while True:
            before = time.perf_counter()
            await asyncio.sleep(0.002)
            self.late.append(time.perf_counter() - before - 0.002)

    def shown(self) -> str:
        late = sorted(self.late)
        p99 = late[int(len(late) * 0.99)] if late else 0.0
        return f"event loop late: p99 {p99 * 1000:.2f} ms, worst {late[-1] * 1000:.1f} ms"


def memory() -> float:
    """MB in use by this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


# -- the other process -------------------------------------------------------------------------


def count(endpoint: str) -> None:
    """Counts what arrives under plant/d*; tells the number whenever a line comes in."""
    arrived = 0

    def heard(_: zenoh.Sample) -> None:
        nonlocal arrived
        arrived += 1

    with zenoh.open(configure(ZenohSettings(mode=Mode.CLIENT, connect=(endpoint,)))) as session:
        subscriber = session.declare_subscriber("plant/**", heard)
        print("ready", flush=True)
        for _ in sys.stdin:
            print(arrived, flush=True)
        subscriber.undeclare()


def flood(endpoint: str, seconds: float) -> None:
    """Everything a stranger might send, as fast as it goes."""
    junk = [
        b"[" * 60_000, b"9" * 60_000, b"NaN", b"", b"\xff" * 100, b'{"value":' * 5000,
        b'"' + b"A" * 60_000 + b'"', b"1e999", b"7",
    ]  # fmt: skip
    keys = [
        "plant/**", "plant/d1/*", "plant/d1/t0", "plant/d1/t0?max_age=0s", "plant/**?_time=[..]",
        "plant/**?max_age=0s", "plant/d1/t0/@meta", "plant/*/@block", "plant/@gateway/demo/**",
        "plant/d1/t0?max_age=" + "9" * 500, "plant/d1/t0?_time=[[[", "plant/d1/t0/@adv/**",
    ]  # fmt: skip
    sent = rounds = 0
    end = time.monotonic() + seconds
    with zenoh.open(configure(ZenohSettings(mode=Mode.CLIENT, connect=(endpoint,)))) as session:
        ignore = zenoh.handlers.Callback(lambda _: None, indirect=False)
        while time.monotonic() < end:
            for payload in junk:
                session.get("plant/d1/t0/@set", ignore, payload=payload, timeout=0.5)
                session.put("plant/d1/t0/@set", payload)
                session.put("plant/**/@set", payload)
            for key in keys:
                session.get(key, ignore, timeout=0.5)
            for _ in range(200):
                session.get("plant/d1/t0", ignore, timeout=0.5)
                session.get("plant/d1/t0/@set", ignore, payload=b"7", timeout=0.5)
            if rounds % 10 == 0:
                session.put("plant/d1/t0/@set", b"7" * 100_000_000)
            rounds += 1
            sent += 3 * len(junk) + len(keys) + 400
    print(sent, flush=True)


@contextmanager
def other(*arguments: object) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "benchmarks.northbound", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(20)


class Counter:
    """The subscriber's count."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"

    def now(self) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        return int(self._process.stdout.readline())

    def until_quiet(self) -> int:
        before = -1
        while (found := self.now()) != before:
            before = found
            time.sleep(0.3)
        return found


# -- measured ----------------------------------------------------------------------------------


def bare(tags: int, devices: int, seconds: float, *, declared: bool) -> float:
    """Samples a second of a loop of puts, as many as arrive. `declared`: beside the tokens and
    queryables of a gateway, against which Zenoh matches each put."""
    endpoint = free_endpoint()
    keys = [f"plant/d{d}/t{n}" for d in range(devices) for n in range(tags // devices)]
    data = b'{"value":123456,"quality":"good","time":"2026-11-20T12:00:00.123456Z"}'
    json_encoding, drop = zenoh.Encoding.APPLICATION_JSON, zenoh.CongestionControl.DROP
    with (
        zenoh.open(configure(ZenohSettings(listen=(endpoint,)))) as session,
        other("count", endpoint) as process,
    ):
        kept = []
        if declared:
            ignore = zenoh.handlers.Callback(lambda _: None, indirect=False)
            for device in range(devices):
                kept.append(session.declare_queryable(f"plant/d{device}/**/@set", ignore))
                kept.append(session.liveliness().declare_token(f"plant/d{device}"))
        counter = Counter(process)
        time.sleep(0.3)
        began, put = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            for key in keys:
                stamp = session.new_timestamp()
                session.put(
                    key, data, encoding=json_encoding, congestion_control=drop, timestamp=stamp
                )
            put += len(keys)
        took = time.perf_counter() - began
        arrived = counter.until_quiet()
    beside = f"beside {len(kept)} declarations" if kept else "and nothing else"
    print(f"bare loop of put {beside}: {put / took:,.0f}/s, {arrived / put:.1%} of them arrived")
    return arrived / took


async def gateway(tags: int, devices: int, seconds: float, for_flood: float) -> float:
    sys.setswitchinterval(SWITCH)  # as the service does
    endpoint = free_endpoint()
    before = memory()
    made = plant(tags, devices)
    with_tags = memory()
    began = time.perf_counter()
    northbound = Northbound(ZenohSettings(listen=(endpoint,)), "demo", made)
    serves = asyncio.create_task(northbound.run())
    await northbound.opened.wait()
    print(f"on Zenoh with {tags:,} tags on {devices} devices after "
          f"{time.perf_counter() - began:.2f} s")  # fmt: skip
    print(f"memory: {before:.0f} MB empty, {with_tags - before:.0f} MB more with the tags, "
          f"{memory() - with_tags:.0f} MB more on Zenoh")  # fmt: skip
    rate = 0.0
    try:
        with other("count", endpoint) as process:
            counter = await asyncio.to_thread(Counter, process)
            await asyncio.sleep(1.0)
            rate = await published(made, northbound, counter, seconds)
        print(f"memory then: {memory():.0f} MB")
        if for_flood:
            await flooded(made, northbound, endpoint, for_flood)
    finally:
        serves.cancel()
        await asyncio.wait([serves])
    return rate


async def published(made: Plant, northbound: Northbound, counter: Counter, seconds: float) -> float:
    for _ in range(2):
        await publish_all(made, northbound)
        await asyncio.to_thread(counter.until_quiet)
    first = await asyncio.to_thread(counter.now)
    gc.collect()
    gc.freeze()  # as the service does once it runs
    lag = Lag()
    probe = asyncio.create_task(lag.run())
    before = northbound.counters()
    began = time.perf_counter()
    sent = 0
    while time.perf_counter() - began < seconds:
        sent += await publish_all(made, northbound)
        while northbound.counters()["published"] - before["published"] < sent - SCAN:
            await asyncio.sleep(0.002)  # the lines would go on; here nothing is to be replaced
    while northbound.counters()["published"] - before["published"] < sent:
        await asyncio.sleep(0.002)
    took = time.perf_counter() - began
    probe.cancel()
    arrived = await asyncio.to_thread(counter.until_quiet) - first
    print(f"gateway: {sent / took:,.0f}/s from mirror to put, {arrived / sent:.1%} arrived; "
          f"{lag.shown()}")  # fmt: skip
    return arrived / took


async def publish_all(made: Plant, northbound: Northbound) -> int:
    """New values of all tags, a scan at a time; how many samples went out."""
    sent, now = 0, time.time_ns()
    for start in range(0, len(made.tags), SCAN):
        samples = [good(tag, now % 1_000_003 + start, now) for tag in made.tags[start:][:SCAN]]
        news = made.mirror.update(samples)
        northbound.publish(news)
        sent += len(news)
        await asyncio.sleep(0)
    return sent


async def flooded(made: Plant, northbound: Northbound, endpoint: str, seconds: float) -> None:
    lag = Lag()
    probe = asyncio.create_task(lag.run())
    before, most = memory(), memory()
    with other("flood", endpoint, seconds) as process:
        while process.poll() is None:
            samples = [good(tag, 1, time.time_ns()) for tag in made.tags[:SCAN]]
            northbound.publish(made.mirror.update(samples))
            most = max(most, memory())
            await asyncio.sleep(0.1)
    probe.cancel()
    print(f"flood of {seconds:g} s: {lag.shown()}; memory {before:.0f} MB, at most {most:.0f} MB")
    print("counted:", json.dumps(northbound.counters()))


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tags", type=int, default=50_000)
    parser.add_argument("--devices", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--flood", type=float, default=0.0)
    options = parser.parse_args(arguments)  # type: ignore[arg-type]  # any iterable will do
    structlog.configure(processors=[_quiet])
    best = bare(options.tags, options.devices, options.seconds, declared=False)
    like = bare(options.tags, options.devices, options.seconds, declared=True)
    rate = asyncio.run(gateway(options.tags, options.devices, options.seconds, options.flood))
    print(f"arrived: {rate:,.0f}/s; {rate / best:.2f} of the bare loop with nothing else, "
          f"{rate / like:.2f} of the bare loop with the same declarations")  # fmt: skip


def _quiet(*_: object) -> str:
    raise structlog.DropEvent


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["count", where]:
            count(where)
        case ["flood", where, how_long]:
            flood(where, float(how_long))
        case _:
            main()
