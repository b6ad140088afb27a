"""The other processes of `northbound` and `history_queries`: subscribers, queries, an idle loop.

They import little: each is started several times.
"""

import asyncio
import json
import os
import sys
import time
from collections import Counter as CounterOf
from contextlib import suppress
from functools import partial

import zenoh

from gateway.config import ZenohConfig, ZenohMode
from gateway.northbound.session.session_settings import configure


class Lag:
    """The delay of the event loop, measured every 2 ms."""

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


def count(endpoint: str) -> None:
    """Counts the samples that arrive, alone or in blocks; prints the count for each input line."""
    arrived = 0

    def heard(_: zenoh.Sample) -> None:
        nonlocal arrived
        arrived += 1

    def block(heard: zenoh.Sample) -> None:
        nonlocal arrived
        arrived += heard.payload.to_bytes().count(b'"quality"')

    with zenoh.open(configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(endpoint,)))) as session:
        subscriber = session.declare_subscriber("plant/**", heard)
        blocks = session.declare_subscriber("plant/*/@block", block)
        print("ready", flush=True)
        for _ in sys.stdin:
            print(arrived, time.process_time(), flush=True)
        subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh has no types for it
        blocks.undeclare()  # type: ignore[no-untyped-call]


def flood(endpoint: str, seconds: float) -> None:
    """Sends queries, writes and junk, as fast as possible."""
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
    with zenoh.open(configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(endpoint,)))) as session:
        ignore: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
            lambda _: None, indirect=False
        )
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


def ask(endpoint: str, seconds: float) -> None:
    """Sends only queries, as fast as possible, and prints how they ended."""
    ended: CounterOf[str] = CounterOf()
    keys = (("plant/d1/t0", None), ("plant/d1/t0/@set", b"7"), ("plant/d1/t0/@meta", None))

    def end(heard: list[zenoh.Reply]) -> None:
        first = heard[0] if heard else None
        ended["silent" if first is None else "answered" if first.ok else "an error"] += 1

    config = configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(endpoint,)))
    # µs. Sooner its own session would close the link when the gateway does not receive for so long,
    # and end all open queries without a reply.
    waiting = "transport/link/tx/queue/congestion_control/block/wait_before_close"
    config.insert_json5(waiting, "60000000")
    with zenoh.open(config) as session:
        asked, until = 0, time.monotonic() + seconds
        while time.monotonic() < until:
            for key, payload in keys:
                heard: list[zenoh.Reply] = []
                on_reply = zenoh.handlers.Callback(
                    heard.append, partial(end, heard), indirect=False
                )
                session.get(key, on_reply, payload=payload, timeout=10.0)
                asked += 1
        patience = time.monotonic() + 15.0
        while ended.total() < asked and time.monotonic() < patience:
            time.sleep(0.05)
    print(json.dumps({"asked": asked, "ended": dict(ended)}), flush=True)


def session_with(endpoint: str) -> zenoh.Session:
    """Opens a session that knows the gateway."""
    config = configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(endpoint,)))
    config.insert_json5("connect/timeout_ms", "60000")
    session = zenoh.open(config)
    with session.declare_querier("plant/**") as querier:
        while not querier.matching_status.matching:  # type: ignore[attr-defined]
            time.sleep(0.001)
    return session


def read(endpoint: str) -> None:
    """Reads the whole history again and again; prints the number of samples so far."""
    os.nice(19)  # a client has a processor of its own, but not here
    count = 0
    with session_with(endpoint) as session:
        while True:
            for _ in session.get("plant/**?_time=[..]", timeout=600.0):
                count += 1
                if count % 1000 == 0:
                    print(count, flush=True)


async def idle(seconds: float) -> None:
    """Prints the delays of an idle event loop on this machine."""
    lag = Lag()
    with suppress(TimeoutError):
        await asyncio.wait_for(lag.run(), seconds)
    print(json.dumps(sorted(lag.late)), flush=True)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["count", where]:
            count(where)
        case ["flood", where, how_long]:
            flood(where, float(how_long))
        case ["ask", where, how_long]:
            ask(where, float(how_long))
        case ["read", where]:
            read(where)
        case ["idle", how_long]:
            asyncio.run(idle(float(how_long)))
