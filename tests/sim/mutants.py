"""Breaks one rule of the gateway at a time and runs the tests: `make mutants SAMPLE=100 SEED=7`.

`mutate.py` makes the mutants. Each runs in a copy of the tree: first with the tests of its room,
then with the rest, at the end with a few stormy seeds of the simulation. What notices it ends its
run. The program prints the survivors, and ends with exit code 1 when there are any.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from tests.sim.mutate import GATEWAY, Mutant, modules_in, mutants_of, sample

ROOT = GATEWAY.parent
LEFT = shutil.ignore_patterns(".*", "__pycache__", "node_modules", "build", "*.egg-info")
PATIENCE = 300.0  # seconds for each check

Command = tuple[str, ...]

# The folders and modules of gateway/ that hold rules, and the tests of each.
ROOMS = {
    "engine": "engine line",
    "planning": "planning engine",
    "line": "line engine",
    "tags": "tags contract engine northbound",
    "values": "test_values.py tags config history/test_timerange.py",
    "protocols": "protocols line",
    "parts/alarms": "alarms",
    "parts/doors": "doors",
    "parts/serving": "serving line",
    "parts/transfers": "transfers",
    "stations/served": "serving stations doors line",
    "transport": "transport doors line",
    "config/sheets": "sheets config cli",
    "config/templates": "config",
    "contract/access/writers.py": "northbound",
    "northbound/group": "northbound",
    "northbound/requests": "northbound",
}
REST = ("tests/engine", "tests/line", "tests/northbound", "tests/cases", "tests/sim")
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider")
STORM = (
    *("-m", "tests.sim.campaign", "--pace", "storm", "--hours", "0.6", "--seeds", "14,20"),
    *("--first", "--workers", "1"),
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What noticed a mutant; `by` is empty when nothing did."""

    mutant: Mutant
    by: str
    seconds: float


def all_mutants(words: Iterable[str] = ()) -> list[Mutant]:
    """Returns the mutants of all rooms whose names hold one of the words."""
    wanted = tuple(words)
    modules = sorted({module for room in ROOMS for module in modules_in(room)})
    made = (mutant for module in modules for mutant in mutants_of(module))
    return [m for m in made if not wanted or any(word in m.name for word in wanted)]


def checks_near(module: str) -> list[str]:
    """Returns the tests of the module's room; those that speak of it most come first."""
    room = max((room for room in ROOMS if module.startswith(room)), key=len)
    folders = [f"tests/{folder}" for folder in ROOMS[room].split()]
    *above, name = module.removesuffix(".py").split("/")
    package, word = ".".join(["gateway", *above]), re.compile(rf"\b{name}\b")
    said = {
        path.relative_to(ROOT).as_posix(): len(word.findall(text)) + 99 * (name in path.stem)
        for folder in folders
        for path in sorted((ROOT / folder).glob("test_*.py"))
        if package in (text := path.read_text())
    }
    return [*sorted((path for path in said if said[path]), key=lambda path: -said[path]), *folders]


def all_checks(module: str) -> dict[str, Command]:
    room = checks_near(module)
    rest = [folder for folder in REST if folder not in room]
    return {"tests": (*PYTEST, *room), "others": (*PYTEST, *rest), "simulation": STORM}


def judged(tree: Path, mutant: Mutant, checks: dict[str, Command]) -> Verdict:
    """Puts a mutant into a tree, and runs check after check until one notices it."""
    began = time.monotonic()
    module = tree / "gateway" / mutant.module
    right = module.read_text()
    module.write_text(mutant.text())
    try:
        by = next((who for who, command in checks.items() if fails(tree, command)), "")
    finally:
        module.write_text(right)
    return Verdict(mutant, by, time.monotonic() - began)


def fails(tree: Path, command: Command) -> bool:
    """Runs a check. A check that does not end has noticed the mutant, too."""
    with subprocess.Popen(
        [sys.executable, *command],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as running:
        try:
            return running.wait(PATIENCE) != 0
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            return True


def verdicts(
    mutants: Iterable[Mutant],
    workers: int,
    checks: Callable[[str], dict[str, Command]] = all_checks,
) -> Iterator[Verdict]:
    """Judges mutants, several at a time; each worker has a copy of the tree."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as pool:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(workers):
            trees.put(shutil.copytree(ROOT, Path(folder) / str(number), ignore=LEFT))

        def one(mutant: Mutant) -> Verdict:
            tree = trees.get()
            try:
                return judged(tree, mutant, checks(mutant.module))
            finally:
                trees.put(tree)

        yield from pool.map(one, mutants)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only mutants whose names hold one of these")
    parser.add_argument("--sample", type=int, default=50, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="which")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    made = all_mutants(options.words)
    drawn = sample(made, options.sample, options.seed)
    survivors, tried = [], 0
    for verdict in verdicts(drawn, options.workers):
        tried += 1
        print(
            f"{verdict.by or 'SURVIVED':10} {verdict.seconds:5.0f} s  {verdict.mutant}", flush=True
        )
        survivors += [] if verdict.by else [verdict.mutant]
    print(f"{tried} of {len(made)} mutants, seed {options.seed}: {len(survivors)} survived")
    for mutant in survivors:
        print(f"  {mutant}")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
