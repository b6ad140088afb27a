"""The start of a large plant: `python -m benchmarks.start`.

It writes two files of 64 lines with 32 simulated Vigor stations each, 100 tags at three intervals
in every station: 204,800 tags. In `alike` all stations have the same tags, in `different` the
addresses of each station are drawn at random. It prints for each file the time, the processor time
and the largest memory of `check`, then for `run` the time until a query of one tag and of all tags
is answered, and the processor time and memory then. `--before` names a checkout of another version:
both are measured in turn, and the last column is the ratio of the processor times.

With `--apart` the stations are in a process of their own, behind TCP ports as slow as the wire, as
real device servers are. Otherwise the simulated stations use the processor of the gateway.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import zenoh

from tests.zenoh_peer import free_endpoint, free_port

INTERVALS = ("1s", "5s", "30s")
KINDS = ("alike", "different")
STEPS = (1, 1, 1, 2, 5, 20)  # from one address to the next
HERE = Path(__file__).parents[1]
PATIENCE = 600.0  # seconds
ALL_WITHIN = 120.0  # seconds in which a query must bring all tags
MB = 1e6


class Sizes(NamedTuple):
    """A plant: lines, devices of a line, tags of a device."""

    lines: int
    devices: int
    tags: int

    @property
    def all_tags(self) -> int:
        return self.lines * self.devices * self.tags


class Taken(NamedTuple):
    """Seconds, seconds of the processor, bytes."""

    step: str
    seconds: float
    processor: float
    memory: float


def rows(
    sizes: Sizes, endpoint: str, *, alike: bool, first_port: int = 0, alarms: bool = False
) -> Iterator[str]:
    """Yields the rows of the file. `first_port`: TCP port of the first line; 0: simulated.

    `alarms`: every tag has one; that of the first tag of a device is raised in each period.
    """
    chance = random.Random(1)
    yield from ("gateway: {name: large}", f"zenoh: {{listen: [{endpoint}]}}", "lines:")
    for line in range(sizes.lines):
        port = f"tcp://127.0.0.1:{first_port + line}" if first_port else "simulator"
        yield f"  line{line}:\n    port: {port}\n    baudrate: 19200\n    devices:"
        for device in range(sizes.devices):
            yield f"      d{line}-{device}:\n        protocol: vigor"
            yield f"        station: {device + 1}\n        tags:"
            number = 0 if alike else chance.randrange(3000)
            for tag in range(sizes.tags):
                every = INTERVALS[tag % len(INTERVALS)]
                limit = f", alarm: {{high: {1000 if tag else 50}}}" if alarms else ""
                settings = f"address: D{number}, type: uint16, every: {every}{limit}"
                yield f"          t{tag}: {{{settings}}}"
                number += 1 if alike else chance.choice(STEPS)


def started(tree: Path, command: str, path: Path) -> subprocess.Popen[bytes]:
    known = {**os.environ, "PYTHONPATH": str(tree)}
    arguments = [sys.executable, "-m", "gateway", command, str(path)]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(arguments, cwd=tree, env=known, stdout=quiet, stderr=quiet)


def checked(tree: Path, path: Path) -> Taken:
    begun = time.monotonic()
    program = started(tree, "check", path)
    _, status, used = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    if program.returncode:
        raise SystemExit(f"check ended with {program.returncode}")
    taken = time.monotonic() - begun
    return Taken("check", taken, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024)


@contextmanager
def stations(path: Path) -> Iterator[None]:
    """Serves the lines of the file in another process."""
    known = {**os.environ, "PYTHONPATH": str(HERE)}
    program = subprocess.Popen(
        [sys.executable, "-m", "gateway", "simulate", str(path)],
        cwd=HERE,
        env=known,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert program.stdout is not None
        while b"Ctrl-C" not in program.stdout.readline():
            if program.poll() is not None:
                raise SystemExit("the stations ended")
        yield
    finally:
        program.terminate()
        program.wait()


def ran(tree: Path, path: Path, endpoint: str, sizes: Sizes) -> list[Taken]:
    begun = time.monotonic()
    program = started(tree, "run", path)

    def taken(step: str) -> Taken:
        fields = Path(f"/proc/{program.pid}/stat").read_text().rpartition(")")[2].split()
        processor = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        memory = int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
        return Taken(step, time.monotonic() - begun, processor, memory)

    try:
        with session(endpoint, begun) as client:
            while not answers(client, "plant/d0-0/t0"):
                time.sleep(0.05)
            found = [taken("run: one tag answers")]
            until = time.monotonic() + ALL_WITHIN
            while time.monotonic() < until:
                asked = time.monotonic()
                count = answers(client, "plant/**")
                seconds = time.monotonic() - asked
                found.append(taken(f"run: {count} tags answer in {seconds:.1f} s"))
                if count == sizes.all_tags:
                    break
            return found
    finally:
        program.terminate()
        program.wait()


def session(endpoint: str, begun: float) -> zenoh.Session:
    """Connects, and waits for the gateway."""
    config = zenoh.Config()
    for name, value in (
        ("mode", "client"),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(name, json.dumps(value))
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() - begun > PATIENCE:
                raise
            time.sleep(0.05)


def answers(client: zenoh.Session, key: str) -> int:
    everything = zenoh.ConsolidationMode.NONE
    return sum(reply.ok is not None for reply in client.get(key, consolidation=everything))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs=3, default=(64, 32, 100), metavar="N")
    parser.add_argument("--apart", action="store_true", help="the stations are another process")
    parser.add_argument("--only", choices=KINDS, help="one kind of file")
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    arguments = parser.parse_args()
    sizes, trees = Sizes(*arguments.sizes), [HERE]
    if arguments.before is not None:
        trees.insert(0, arguments.before.resolve())
    print("| tags | step | s | s of processor | MB | x processor |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS if arguments.only is None else (arguments.only,):
            endpoint, path = free_endpoint(), Path(folder) / f"{kind}.yaml"
            first = free_port(sizes.lines) if arguments.apart else 0
            text = rows(sizes, endpoint, alike=kind == "alike", first_port=first)
            path.write_text("\n".join(text) + "\n")
            with stations(path) if first else nullcontext():
                measured = [
                    [checked(tree, path), *ran(tree, path, endpoint, sizes)] for tree in trees
                ]
            for tree, found in zip(trees, measured, strict=True):
                name = kind if tree == HERE else f"{kind}, before"
                for one, before in zip_longest(found, measured[0][: len(found)]):
                    ratio = "" if before is None else f"{one.processor / before.processor:.2f}"
                    print(
                        f"| {name} | {one.step} | {one.seconds:.1f} | {one.processor:.1f} | "
                        f"{one.memory / MB:.0f} | {ratio} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
