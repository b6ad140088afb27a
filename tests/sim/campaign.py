"""Runs many seeds: `make sim SEEDS=0-499 HOURS=4 PACE=lean`, or one: `make sim SEEDS=17`.

Each seed that breaks a rule is one line with its rules and the command that replays it; a single
seed prints all its reports. With `--result FILE` every finished seed is a line of the file; a
campaign that ended early continues there. `--part 1/4` runs a quarter of the seeds. `--total`
adds up the files of all parts.
"""

import argparse
import gc
import json
import multiprocessing
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from tests.sim import doors, liveness, north
from tests.sim.draw import PACES
from tests.sim.foreign import Case
from tests.sim.north_clients import GROUPS
from tests.sim.story import Story
from tests.sim.world import run

# Paces of the worlds of `north.py`, `liveness.py` and `doors.py`.
NORTH, LIVENESS, DOORS = "north", "liveness", "doors"
MOST = ("most timers", "most open")  # counts of which the largest is printed
# Counts in the total.
WORDS = ("frames", "good samples", *(case.value for case in Case if case.value), "internal errors")
DOOR_WORDS = ("read", "written", "value", "no reply", "wire lent", "reload", "internal errors")
NORTH_WORDS = ("published", "received", "lost by congestion", "answers", "pages", "executed")


@dataclass
class Total:
    """The sum of the seeds of one pace."""

    seeds: int = 0
    hours: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    rules: Counter[str] = field(default_factory=Counter)  # by rule: seeds that broke it
    broken: int = 0

    def add(self, story: Story) -> None:
        self.seeds += 1
        self.hours += story.hours
        most = {name: max(self.counts[name], story.counts[name]) for name in MOST}
        self.counts += story.counts
        self.counts.update({name: number - self.counts[name] for name, number in most.items()})
        self.rules.update(set(story.rules()))
        self.broken += bool(story.broken)

    def __str__(self) -> str:
        broken = ", ".join(f"{rule}: {seeds}" for rule, seeds in self.rules.most_common())
        counted = WORDS if self.counts["frames"] else NORTH_WORDS
        if self.counts["wire lent"]:
            counted = DOOR_WORDS
        numbers = "".join(f"{self.counts[word]} {word}, " for word in counted)
        return (
            f"{self.seeds} seeds, {self.hours:g} hours, {numbers}"
            f"{self.broken} seeds with a broken rule {broken and f'({broken})'}"
        ).rstrip()


def seeds(text: str) -> list[int]:
    """Parses `0-499`, `17` or `3,5,17`."""
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


def part(text: str) -> tuple[int, int]:
    """Parses `1/4`."""
    which, _, of = text.partition("/")
    return int(which), int(of)


def stories(path: Path) -> Iterator[Story]:
    """Yields the seeds of a result file."""
    for line in path.read_text().splitlines() if path.exists() else ():
        said = json.loads(line)
        said["counts"], said["only"] = Counter(said["counts"]), tuple(said["only"])
        yield Story(**said)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=seeds("0-19"), metavar="0-19")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument(
        "--pace", choices=sorted([*PACES, NORTH, GROUPS, LIVENESS, DOORS]), default="busy"
    )
    parser.add_argument("--only", default="", help="kinds of faults, with commas")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--part", type=part, default=(1, 1), metavar="1/4")
    parser.add_argument("--result", type=Path, help="a line for each seed; skips those in it")
    parser.add_argument("--total", type=Path, nargs="+", help="only adds up these files")
    parser.add_argument("--first", action="store_true", help="end at the first broken seed")
    chosen = parser.parse_args()
    if chosen.total:
        return _totals(story for path in chosen.total for story in stories(path))
    known = list(stories(chosen.result)) if chosen.result else []
    only = tuple(filter(None, chosen.only.split(",")))
    done = {
        story.seed
        for story in known
        if (story.hours, story.pace, story.only) == (chosen.hours, chosen.pace, only)
    }
    which, of = chosen.part
    left = [seed for seed in chosen.seeds[which - 1 :: of] if seed not in done]
    began = time.monotonic()
    gc.set_threshold(100_000)
    with multiprocessing.Pool(chosen.workers, maxtasksperchild=20) as pool:
        others = {NORTH: north.run, GROUPS: north.run, LIVENESS: liveness.run, DOORS: doors.story}
        run_one = others.get(chosen.pace, run)
        task = partial(run_one, hours=chosen.hours, pace=chosen.pace, only=only, traced=False)
        for story in pool.imap_unordered(task, left):
            known.append(story)
            if chosen.result:
                with chosen.result.open("a") as file:
                    file.write(json.dumps(vars(story)) + "\n")
            if story.broken:
                print(_line(story), flush=True)
            if story.broken and chosen.first:
                break
    for story in known:
        if wrong := {case.value: n for case in Case if (n := story.counts[case.value])}:
            print(f"{story.seed}: {', '.join(f'{n} {what}' for what, n in wrong.items())}")
    if len(chosen.seeds) == 1:
        for story in known:
            print("\n".join(story.broken))
            print(json.dumps(dict(sorted(story.counts.items())), indent=2))
    print(f"{len(left)} seeds in {(time.monotonic() - began) / 60:.1f} minutes")
    return _totals(known)


def _line(story: Story) -> str:
    """Returns the rules that a seed breaks, and how to repeat it."""
    rules = ", ".join(f"{rule} x{times}" for rule, times in story.rules().most_common())
    return f"{story.replay()} # {rules}: {story.broken[0]}"


def _totals(known: Iterable[Story]) -> int:
    totals: defaultdict[str, Total] = defaultdict(Total)
    for story in known:
        totals[story.pace].add(story)
    for pace, total in sorted(totals.items()):
        print(f"{pace}: {total}")
    return int(any(total.broken for total in totals.values()))


if __name__ == "__main__":
    sys.exit(main())
