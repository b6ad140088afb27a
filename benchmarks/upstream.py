"""Faults of Zenoh that concern this gateway, without it: `python -m benchmarks.upstream NAME`.

`dead-route`: a peer keeps the route of a key expression to a router that was killed.
`wildcards`: two key expressions with many `**` keep a receiving thread busy for ever.
docs/contributors/upstream.md has the reports.
"""

import argparse
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import zenoh

from tests.zenoh_peer import free_endpoint

QUERY_WITHIN = 5.0  # seconds
TAGS = 5


def session(mode: str, listen: str = "", connect: str = "") -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        "timestamping/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _serve(ready: Connection, mode: str, listen: str, connect: str, *, answers: bool) -> None:
    """One process: a session that answers five keys, or only routes."""

    def reply(query: zenoh.Query) -> None:
        for n in range(TAGS):
            query.reply(f"plant/mixer/t{n}", b"1")

    with session(mode, listen, connect) as opened:
        queryable = opened.declare_queryable("plant/**", reply) if answers else None
        ready.send(os.getpid())
        time.sleep(3600)
        del queryable


class Served:
    """A session in a process of its own."""

    def __init__(self, mode: str, listen: str, connect: str = "", *, answers: bool = True) -> None:
        here, there = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(
            target=_serve, args=(there, mode, listen, connect), kwargs={"answers": answers}
        )
        self._process.start()
        self.pid: int = here.recv()

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        self._process.join()


def ask(endpoint: str, key: str) -> str:
    """Returns the number of replies, errors and seconds of one query of a new client."""
    with session("client", connect=endpoint) as client:
        began = time.monotonic()
        how: dict[str, Any] = {
            "timeout": QUERY_WITHIN,
            "target": zenoh.QueryTarget.ALL,
            "consolidation": zenoh.ConsolidationMode.NONE,
        }
        replies = list(client.get(key, **how))
        good = sum(reply.ok is not None for reply in replies)
        took = time.monotonic() - began
    return f"{good} replies, {len(replies) - good} errors, {took:.1f} s"


def dead_route(_seconds: int) -> None:
    for mode in ("peer", "router"):
        router_at, gateway_at = free_endpoint(), free_endpoint()
        router = Served("router", router_at, answers=False)
        gateway = Served(mode, gateway_at, router_at)
        time.sleep(1.0)
        print(f"{mode}: through the router: {ask(router_at, 'plant/**')}")
        print(f"{mode}: the router lives: {ask(gateway_at, 'plant/**')}")
        router.kill()
        time.sleep(2.0)
        print(f"{mode}: the router is dead, the same key: {ask(gateway_at, 'plant/**')}")
        print(f"{mode}: the router is dead, another key: {ask(gateway_at, 'plant/*/*')}")
        gateway.kill()


def wildcards(seconds: int) -> None:
    endpoint = free_endpoint()
    peer = Served("peer", endpoint)
    ends = ("**", "b")
    clients = [session("client", connect=endpoint) for _ in ends]
    keys = ["plant/" + "**/a/" * 20 + end for end in ends]
    kept = [one.declare_subscriber(key) for one, key in zip(clients, keys, strict=True)]
    for second in range(1, seconds + 1):
        time.sleep(1.0)
        size = Path(f"/proc/{peer.pid}/status").read_text().split("VmRSS:")[1].split()[0]
        print(f"after {second} s: {int(size) // 1024} MB")
    peer.kill()
    del kept


PROGRAMS: dict[str, Callable[[int], None]] = {"dead-route": dead_route, "wildcards": wildcards}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=sorted(PROGRAMS))
    parser.add_argument("--seconds", type=int, default=8, help="of wildcards: a GB in ten")
    chosen = parser.parse_args()
    PROGRAMS[chosen.name](chosen.seconds)


if __name__ == "__main__":
    main()
