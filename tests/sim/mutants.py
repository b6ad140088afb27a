"""Breaks one rule of the gateway at a time and runs the tests: `make mutants`.

Each mutant is one replacement in a copy of the tree. Two checks run on it: the tests of the module
and a few stormy seeds of the simulation. The program prints which check caught it, and its time.
It ends with exit code 1 when a mutant lives, or when a text to be replaced is missing.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.sim.broken import MUTANTS, Mutant

ROOT = Path(__file__).parents[2]
TREE = (
    *("gateway", "tests", "benchmarks", "docs", "examples", "README.md", "pyproject.toml"),
    *("config.example.yaml", "config.schema.json"),
)
PATIENCE = 180.0  # seconds for each check; a test that fails may wait 60 s


def check(tree: Path, command: list[str]) -> tuple[bool, float, str]:
    """Runs a check. Returns whether it failed, after how many seconds, and its message."""
    began = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tree,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, PATIENCE, "took too long"
    said = [line.strip() for line in done.stdout.splitlines() if _tells(line)]
    minded = done.returncode == 1 and bool(said)  # not an error before any test was run
    return minded, time.monotonic() - began, said[0][:110] if said else done.stderr[-110:].strip()


def _tells(line: str) -> bool:
    return line.startswith("FAILED") or " s: " in line


def simulation(mutant: Mutant) -> list[str]:
    numbers = ",".join(map(str, mutant.seeds))
    return [
        *("-m", "tests.sim.campaign", "--pace", mutant.pace, "--hours", str(mutant.hours)),
        *("--seeds", numbers, "--first", "--workers", "1"),
    ]


def tests(files: str) -> list[str]:
    return ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files.split()]


@contextmanager
def put_in(tree: Path, mutant: Mutant) -> Iterator[bool]:
    """Applies the mutant. Yields False when its text is missing, or not unique."""
    path = tree / "gateway" / mutant.file
    text = path.read_text()
    path.write_text(text.replace(mutant.old, mutant.new))
    try:
        yield text.count(mutant.old) == 1
    finally:
        path.write_text(text)


def stale() -> list[str]:
    """The mutants whose text is missing in the gateway, or not unique."""
    return [
        mutant.name
        for mutant in MUTANTS
        if (ROOT / "gateway" / mutant.file).read_text().count(mutant.old) != 1
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only mutants whose names hold one of these")
    parser.add_argument("--quick", action="store_true", help="no simulation of what tests caught")
    options = parser.parse_args()
    words = options.words
    alive = 0
    for name in stale():
        print(f"STALE: the text to replace is not there, or not once: {name}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in TREE:
            source = ROOT / name
            if source.is_dir():
                leave = shutil.ignore_patterns("__pycache__", "node_modules")
                shutil.copytree(source, tree / name, ignore=leave)
            else:
                shutil.copy(source, tree / name)
        for mutant in MUTANTS:
            if words and not any(word in mutant.name for word in words):
                continue
            with put_in(tree, mutant) as there:
                alive += not (there and _judged(tree, mutant, quick=options.quick))
                if not there:
                    print(f"{mutant.name}: NOT TRIED, its text is not in {mutant.file}", flush=True)
    print("all mutants were caught" if not alive else f"{alive} mutants live")
    return int(bool(alive))


def _judged(tree: Path, mutant: Mutant, *, quick: bool) -> bool:
    print(mutant.name, flush=True)
    caught = False
    for who, command in (
        ("tests", tests(mutant.tests)),
        ("simulation", simulation(mutant)),
    ):
        if caught and quick:
            break
        minded, seconds, said = check(tree, command)
        caught |= minded
        print(f"    {who:10} {'caught' if minded else '-':6} {seconds:5.1f} s  {said}", flush=True)
    return caught


if __name__ == "__main__":
    sys.exit(main())
