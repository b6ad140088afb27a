"""Queries of the past beside queries of current values: `python -m benchmarks.history_queries`.

A gateway process serves a history file to clients in processes of their own. Measured:

* the time of `get plant/**` of the current values of 1,000 tags, with no other client, and while
  three clients read the whole history again and again, in turn;
* `examples/catch_up.py` from the beginning of another file: the time to its first and to its last
  sample.
"""

import argparse
import asyncio
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import zenoh

from benchmarks.history import tags
from benchmarks.northbound import Device, Plant
from benchmarks.northbound_clients import session_with
from gateway.config import ZenohConfig
from gateway.northbound.northbound import Northbound
from gateway.parts.history.answers.recent import MOST_RUNS
from gateway.parts.history.historian import Historian
from gateway.service.service import THREAD_SWITCH
from gateway.tags import Tag, good
from tests.no_parts import NoParts
from tests.northbound.plant import running
from tests.zenoh_peer import free_endpoint

ROOT = Path(__file__).parents[1]
GIGABYTE = 10**9


class Kept(NoParts):
    """A history, and no other part."""

    def __init__(self, historian: Historian) -> None:
        self._kept = historian

    def history(self) -> Historian:
        return self._kept


def write(path: Path, some: Sequence[Tag], samples: int) -> None:
    """Records samples of the last day, of the tags in turn."""
    historian = Historian(path, 7 * 86400.0, 4 * GIGABYTE)
    historian.start()
    count, start = len(some), time.time_ns() - 86400 * 10**9
    step = 80_000 * 10**9 // samples
    for at in range(0, samples, 1000):
        historian.record(
            good(some[n % count], n / 8, start + n * step) for n in range(at, at + 1000)
        )
        while int(str(historian.document()["waiting"])) > 30_000 * (MOST_RUNS - 2):
            time.sleep(0.01)
    assert historian.close(600)


# -- other processes ---------------------------------------------------------------------------


async def serve(endpoint: str, path: Path, count: int) -> None:
    sys.setswitchinterval(THREAD_SWITCH)
    by_device: dict[str, Device] = {}
    for tag in tags(count):
        by_device.setdefault(tag.device, Device(tag.device, [])).tags.append(tag)
    plant = Plant(list(by_device.values()))
    plant.mirror.update([good(tag, 1.5, time.time_ns()) for tag in plant.tags])
    historian = Historian(path, 7 * 86400.0, 4 * GIGABYTE)
    historian.start()
    while historian.document()["state"] != "ok":
        await asyncio.sleep(0.01)
    settings = ZenohConfig(listen=(endpoint,))
    northbound = Northbound(settings, "demo", plant, parts=Kept(historian))
    async with running(northbound):
        print("ready", flush=True)
        await asyncio.Event().wait()


# -- the measurements --------------------------------------------------------------------------


@contextmanager
def other(program: str, *arguments: object) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", f"benchmarks.{program}", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()


def beside(folder: Path, samples: int, rounds: int, queries: int) -> None:
    path, endpoint = folder / "beside.db", free_endpoint()
    write(path, tags(1000), samples)
    alone, crowded = list[float](), list[float]()
    with other("history_queries", "serve", endpoint, path, 1000), session_with(endpoint) as session:
        for _ in range(rounds):
            alone += _asked(session, queries)
            with ExitStack() as stack:
                for _ in range(3):
                    stack.enter_context(other("northbound_clients", "read", endpoint))
                crowded += _asked(session, queries)
    for what, took in (("alone", sorted(alone)), ("beside three readers", sorted(crowded))):
        p50, p99 = took[len(took) // 2], took[int(len(took) * 0.99)]
        print(f"get plant/** {what}: p50 {p50 * 1e3:.1f} ms, p99 {p99 * 1e3:.1f} ms")


def _asked(session: zenoh.Session, queries: int) -> list[float]:
    took = []
    for _ in range(queries):
        begun = time.perf_counter()
        found = session.get("plant/**", consolidation=zenoh.ConsolidationMode.NONE)
        assert sum(1 for reply in found if reply.ok is not None) == 1000
        took.append(time.perf_counter() - begun)
        time.sleep(0.02)
    return took


def catch_up(folder: Path, count: int, samples: int) -> None:
    path, endpoint = folder / "catch-up.db", free_endpoint()
    write(path, tags(count), samples)
    example = [sys.executable, "examples/catch_up.py", "--connect", endpoint]
    with other("history_queries", "serve", endpoint, path, count):
        begun = time.perf_counter()
        with subprocess.Popen(
            [*example, "--since", "2000-01-01T00:00:00Z"], stdout=subprocess.PIPE, cwd=ROOT
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            first = time.perf_counter() - begun
            for _ in range(samples - 1):
                process.stdout.readline()
            took = time.perf_counter() - begun
            process.kill()
    print(
        f"catch_up of {samples:,} samples of {count:,} tags: first {first:.2f} s, all {took:.1f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--queries", type=int, default=100)
    parser.add_argument("--missed", type=int, default=2_400_000)
    parser.add_argument("--tags", type=int, default=40_000)
    parser.add_argument("--folder", type=Path, help="a folder on the disk to be measured")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        catch_up(Path(name), given.tags, given.missed)
        beside(Path(name), given.samples, given.rounds, given.queries)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["serve", where, path, count]:
            asyncio.run(serve(where, Path(path), int(count)))
        case _:
            main()
