"""Speed of recording and of queries of the history file: `python -m benchmarks.history`.

An event loop records samples, as in the gateway, at a fixed rate or as fast as possible, and
measures its own stalls. Then queries read the same file.
"""

import argparse
import asyncio
import gc
import random
import resource
import tempfile
import time
from pathlib import Path

from benchmarks.northbound import memory
from gateway.parts.history.answers.recent import MOST_RUNS
from gateway.parts.history.historian import Historian
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Publishing, Sample, Tag, good
from gateway.values import Layout, parse_type

GIGABYTE = 10**9


def tags(count: int) -> list[Tag]:
    return [
        Tag(
            device=f"plc{n // 1000}",
            name=f"t{n % 1000}",
            text="D100",
            address=Address("D", 100),
            span=Span("D", 100, 1),
            unit_kind=Unit.WORD,
            layout=Layout(parse_type("float32")),
            publishing=Publishing(history=True),
        )
        for n in range(count)
    ]


async def stalls(late: list[float]) -> None:
    while True:
        due = time.perf_counter() + 0.002
        await asyncio.sleep(0.002)
        late.append(time.perf_counter() - due)


async def record(historian: Historian, some: list[Tag], rate: float, seconds: float) -> list[float]:
    """Records scans of 100 tags; `rate` 0: as fast as possible. Returns the stalls."""
    late: list[float] = []
    watch = asyncio.create_task(stalls(late))
    until = time.perf_counter() + seconds
    begun, done, at = time.perf_counter(), 0, 0
    while time.perf_counter() < until:
        scan: list[Sample] = []
        now = time.time_ns()
        for _ in range(100):
            scan.append(good(some[at], random.random() * 100, now))
            at = (at + 1) % len(some)
        historian.record(scan)
        done += len(scan)
        waiting = historian.document()["waiting"]
        assert isinstance(waiting, int)
        if rate:
            ahead = begun + done / rate - time.perf_counter()
            await asyncio.sleep(max(0.0, ahead))
        else:
            await asyncio.sleep(0.01 if waiting > 30_000 else 0)
    watch.cancel()
    return late


def cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def written() -> int:
    """Returns the bytes that this process has given to the disk."""
    found = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(found["write_bytes"])


def insert(folder: Path, count: int, rate: float, seconds: float) -> None:
    path = folder / f"{count}-{rate:.0f}.db"
    historian = Historian(path, 7 * 86400.0, GIGABYTE)
    historian.start()
    some = tags(count)
    begun, used, wrote = time.perf_counter(), cpu(), written()
    late = sorted(asyncio.run(record(historian, some, rate, seconds)))
    assert historian.close(60)
    took, used, wrote = time.perf_counter() - begun, cpu() - used, written() - wrote
    document = historian.document()
    stored = document["stored"]
    assert isinstance(stored, int)
    print(
        f"{count:7} {rate or 'all':>8} {stored / took:11,.0f} {document['lost']:6} "
        f"{used / took:6.0%} {path.stat().st_size / stored:7.1f} {wrote / stored:7.1f} "
        f"{late[len(late) // 2] * 1e3:6.2f} {late[len(late) * 99 // 100] * 1e3:6.2f} "
        f"{late[-1] * 1e3:6.1f}"
    )
    path.unlink()


def query(folder: Path, count: int, samples: int) -> None:
    path = folder / f"query-{count}.db"
    historian = Historian(path, 7 * 86400.0, GIGABYTE)
    historian.start()
    some = tags(count)
    start = time.time_ns() - 86400 * 10**9
    step = 80_000 * 10**9 // samples
    for at in range(0, samples, 1000):
        historian.record(
            good(some[n % count], random.random() * 100, start + n * step)
            for n in range(at, at + 1000)
        )
        while int(str(historian.document()["waiting"])) > 30_000 * (MOST_RUNS - 2):
            time.sleep(0.01)
    assert historian.close(60)
    historian = Historian(path, 7 * 86400.0, GIGABYTE)
    historian.start()
    while historian.document()["state"] != "ok":
        time.sleep(0.01)
    asks = {"all": "[..]", "10 min": "[now(-12h)..now(-710m)]", "first": "[..]"}
    for what, text in asks.items():
        limit = 1 if what == "first" else None
        tried = 1 if what == "all" and count < 10 else 50
        gc.collect()
        before = most = memory()
        begun, found = time.perf_counter(), 0
        for n in range(tried):
            for number, _ in enumerate(historian.samples(some[n % count], text, limit), 1):
                found += 1
                if number % 10_000 == 0:
                    most = max(most, memory())
        took = time.perf_counter() - begun
        print(
            f"{count:7} {samples:9,} {what:>7} {found // tried:9,} "
            f"{took / tried * 1e3:9.2f} {found / took:12,.0f} {most - before:6.1f}"
        )
    historian.close()
    path.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--tags", nargs="*", type=int, default=[100, 5_000, 50_000])
    parser.add_argument(
        "--rates", nargs="*", type=float, default=[10_000.0, 50_000.0, 0.0], help="samples a second"
    )
    parser.add_argument("--folder", type=Path, help="a folder on the disk to be measured")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        print("recording; stalls of the event loop in ms")
        print(
            f"{'tags':>7} {'offered':>8} {'stored/s':>11} {'lost':>6} {'CPU':>6} {'bytes':>7} "
            f"{'written':>7} {'p50':>6} {'p99':>6} {'max':>6}"
        )
        for count in given.tags:
            for rate in given.rates:
                insert(Path(folder), count, rate, given.seconds)
        print("asking one tag; ms for each question, MB by which the process grew meanwhile")
        print(f"{'tags':>7} {'in file':>9} {'range':>7} {'found':>9} {'ms':>9} {'samples/s':>12} "
              f"{'MB':>6}")  # fmt: skip
        for count in (1, 100, 5_000):
            query(Path(folder), count, given.samples)


if __name__ == "__main__":
    main()
