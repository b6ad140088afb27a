"""Runs many seeds: `make sim SEEDS=0-499 HOURS=4 PACE=lean`, or one: `make sim SEEDS=17`.

Each seed that breaks a rule is printed with the command that replays it.
"""

import argparse
import gc
import json
import multiprocessing
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

from tests.sim.draw import PACES
from tests.sim.story import Story
from tests.sim.world import run

MOST = ("most timers", "most open")  # counts of which the largest is printed


def seeds(text: str) -> list[int]:
    """Parses `0-499`, `17` or `3,5,17`."""
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=seeds("0-19"), metavar="0-19")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--pace", choices=sorted(PACES), default="busy")
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--result", type=Path)
    parser.add_argument("--first", action="store_true", help="end at the first broken seed")
    chosen = parser.parse_args()
    gc.set_threshold(100_000)
    began = time.monotonic()
    counts: Counter[str] = Counter()
    broken: list[Story] = []
    done = 0
    with multiprocessing.Pool(chosen.workers, maxtasksperchild=20) as pool:
        task = partial(run, hours=chosen.hours, pace=chosen.pace)
        for story in pool.imap_unordered(task, chosen.seeds):
            done += 1
            most = {name: max(counts[name], story.counts[name]) for name in MOST}
            counts += story.counts
            for name, number in most.items():
                counts[name] = number
            if story.broken:
                broken.append(story)
                print("\n  ".join([story.replay(), *story.broken]), flush=True)
            if story.broken and chosen.first:
                break
            if chosen.result:
                _note(chosen.result, done, chosen.hours, counts, broken, began)
    took = time.monotonic() - began
    print(json.dumps(dict(sorted(counts.items())), indent=2))
    print(
        f"{done} seeds, {done * chosen.hours:g} simulated hours in {took / 60:.1f} minutes "
        f"({chosen.pace}), {len(broken)} seeds with a broken rule"
    )
    return int(bool(broken))


def _note(
    path: Path, done: int, hours: float, counts: Counter[str], broken: list[Story], began: float
) -> None:
    path.write_text(
        json.dumps(
            {
                "seeds": done,
                "hours": done * hours,
                "minutes": round((time.monotonic() - began) / 60, 1),
                "broken": {story.seed: story.broken for story in broken},
                "counts": counts,
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
