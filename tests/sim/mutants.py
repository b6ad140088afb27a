"""Break the gateway by hand, one rule at a time, and see who notices: `make mutants`.

Each mutant is one replacement in a copy of the tree. Two checks look at it, the tests of the
module and a few stormy seeds of the simulation; who caught it, and in what time, is printed.
Ends with exit code 1 when a mutant lives, or when a text to be replaced is not there any more.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
TREE = ("gateway", "tests", "benchmarks", "docs", "examples", "README.md", "pyproject.toml")
TREE += ("config.example.yaml", "config.schema.json")
PATIENCE = 60.0  # seconds for each check
HOURS = "0.6"  # storms, then calm


@dataclass(frozen=True)
class Mutant:
    """`old` becomes `new` in `file`; `tests` and `seeds` should mind."""

    name: str
    file: str
    old: str
    new: str
    tests: str
    seeds: tuple[int, ...] = (14, 20)
    pace: str = "storm"


MUTANTS = (
    Mutant(
        "no late-reply guard",
        "line.py",
        "guard = 0.0 if before is Standing.SILENT else device.late_guard",
        "guard = 0.0",
        "tests/test_line.py",
        (54, 55, 53, 48),
        "late",
    ),
    Mutant(
        "no doubt after a failure: no resync",
        "device.py",
        "        self.doubtful = not self.broadcast\n        if doubt is not None:",
        "        if doubt is not None:",
        "tests/test_line.py",
        (54, 55, 53, 14, 48),
        "tardy",
    ),
    Mutant(
        "an answer heard before the question counts",
        "turn.py",
        "                self._codec = self.new_codec()\n",
        "                pass\n",
        "tests/test_turn.py",
    ),
    Mutant(
        "Vigor: any sum is right",
        "protocols/vigor/codec.py",
        "if byte_sum(whole[1:-2]) != check:",
        "if False:",
        "tests/protocols/test_vigor.py",
        (20, 6, 59, 48, 54),
        "noisy",
    ),
    Mutant(
        "Vigor: any station's answer is taken",
        "protocols/vigor/driver.py",
        "frame.station != station or frame.command != command",
        "frame.command != command",
        "tests/protocols/test_vigor.py",
        (20, 6, 54),
    ),
    Mutant(
        "Computer Link: any sum is right",
        "protocols/computer_link/codec.py",
        "if heard != byte_sum(bytes(buffer[1 : etx + 1])):",
        "if False:",
        "tests/protocols/test_computer_link_codec.py tests/protocols/test_computer_link.py",
        (23, 52, 21, 56, 55),
        "noisy",
    ),
    Mutant(
        "Modbus RTU: any CRC is right",
        "protocols/modbus/rtu.py",
        "crc16(whole[:-2]) == whole[-2:]:\n                del heard[: start + size]\n"
        "                return Frame(whole[0], whole[1:-2])\n            if whole[:2] != self",
        "True:\n                del heard[: start + size]\n"
        "                return Frame(whole[0], whole[1:-2])\n            if whole[:2] != self",
        "tests/protocols/test_modbus_codecs.py",
        (14, 44, 12, 36, 7),
        "noisy",
    ),
    Mutant(
        "Modbus ASCII: any LRC is right",
        "protocols/modbus/ascii.py",
        "if len(octets) < 3 or sum(octets) & 0xFF:",
        "if len(octets) < 3:",
        "tests/protocols/test_modbus_codecs.py",
        (15, 34, 53),
        "noisy",
    ),
    Mutant(
        "Modbus: any station's answer is taken",
        "protocols/modbus/dialogue.py",
        "            if frame.station != station or frame.transaction != number:",
        "            if frame.transaction != number:",
        "tests/protocols/test_modbus.py",
        (14, 36, 53),
    ),
    Mutant(
        "repeat does not ask the rule",
        "writing.py",
        "return await carry_out(talk, write, wall) if rule.repeat and in_time else None",
        "return await carry_out(talk, write, wall) if in_time else None",
        "tests/test_writing.py tests/test_line.py",
        (20, 14, 12),
    ),
    Mutant(
        "verify believes everything",
        "writing.py",
        "    return list(units) == list(write.units)\n",
        "    return True\n",
        "tests/test_writing.py tests/test_line.py",
        (20, 14, 12, 59, 23, 44),
    ),
    Mutant(
        "no demotion: a dead device is asked for ever",
        "consequences.py",
        "        if not unknown and device.failures <= device.timing.retries:\n",
        "        if not unknown:\n",
        "tests/test_line.py",
    ),
    Mutant(
        "values of a silent device stay good",
        "consequences.py",
        "        now = self.wall()\n        self.upstairs.samples([bad(",
        "        if reason is Reason.NO_REPLY:\n            return\n"
        "        now = self.wall()\n        self.upstairs.samples([bad(",
        "tests/test_line.py",
    ),
    Mutant(
        "values stay good when the port is gone",
        "consequences.py",
        "            self.bad(device.tags, Reason.LINE_DOWN, why)",
        "            pass",
        "tests/test_line.py",
    ),
    Mutant(
        "an echo is taken for an answer",
        "turn.py",
        "        if self._echo and not (data := self._strip_echo(data)):\n            return\n",
        "",
        "tests/test_turn.py tests/test_line.py",
        (6, 2),
    ),
    Mutant(
        "half of the wire's time is not kept for healthy devices",
        "schedule.py",
        "        self._failed_lane = now + took\n",
        "        self._failed_lane = now\n",
        "tests/test_schedule.py tests/test_line.py",
    ),
    Mutant(
        "age by a clock that people set",
        "app.py",
        "if known.quality is Quality.GOOD and self._age(tag) <= max_age:",
        "if known.quality is Quality.GOOD and self._wall() - known.time <= max_age * 1e9:",
        "tests/cases",
        (14, 20, 42, 52),
    ),
    Mutant(
        "who asked in vain is remembered",
        "app.py",
        "            self._forget(tag, asked)\n",
        "            pass\n",
        "tests/cases",
        (14, 20, 42, 52),
    ),
    Mutant(
        "places left by hastened polls are kept",
        "schedule.py",
        "        if len(self._waiting) > self._roomy:\n",
        "        if False:\n",
        "tests/cases",
        (11, 20, 48),
    ),
    Mutant(
        "a port is not given back",
        "line.py",
        "            await port.close()\n",
        "            pass\n",
        "tests/test_line.py tests/test_app.py",
    ),
)


def check(tree: Path, command: list[str]) -> tuple[bool, float, str]:
    """Whether it minded, after how many seconds, and what it said last."""
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
        *("-m", "tests.sim.campaign", "--pace", mutant.pace, "--hours", HOURS),
        *("--seeds", numbers, "--first", "--workers", "1"),
    ]


def tests(files: str) -> list[str]:
    return ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files.split()]


@contextmanager
def put_in(tree: Path, mutant: Mutant) -> Iterator[bool]:
    """False when the text is not there, or not once."""
    path = tree / "gateway" / mutant.file
    text = path.read_text()
    path.write_text(text.replace(mutant.old, mutant.new))
    try:
        yield text.count(mutant.old) == 1
    finally:
        path.write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only mutants whose names hold one of these")
    words = parser.parse_args().words
    alive = 0
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
                alive += not (there and _judged(tree, mutant))
                if not there:
                    print(f"{mutant.name}: the text to replace is not in {mutant.file}", flush=True)
    print("all mutants were caught" if not alive else f"{alive} mutants live")
    return int(bool(alive))


def _judged(tree: Path, mutant: Mutant) -> bool:
    print(mutant.name, flush=True)
    caught = False
    for who, command in (
        ("tests", tests(mutant.tests)),
        ("simulation", simulation(mutant)),
    ):
        minded, seconds, said = check(tree, command)
        caught |= minded
        print(f"    {who:10} {'caught' if minded else '-':6} {seconds:5.1f} s  {said}", flush=True)
    return caught


if __name__ == "__main__":
    sys.exit(main())
