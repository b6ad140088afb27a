"""The figures of the gateway against its aims, within ten minutes: `make bench`.

It runs the scenario of 100,000 values (`benchmarks.scenarios`), grows the gateway from 1,000 to
198,400 tags and from 1 to 1,000 devices at the same number of values and reads a second, and
measures a read beside other Modbus clients, a plan, and `check` of a large file. A run beside other
work on the machine says so, and is repeated while there is time. `--docs` writes the kept result
into the page, with its drawing.
"""

import argparse
import json
import logging
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import structlog

from benchmarks import drawing, planning, scenarios, start, transactions
from benchmarks.scenarios import Load, Scenario, Times
from tests.zenoh_peer import free_endpoint

PAGE = scenarios.HERE / "docs" / "performance.md"
DRAWING = PAGE.with_name("growth.svg")
RESULTS = scenarios.HERE / "benchmarks" / "results" / "performance.json"
WITHIN = 540.0  # seconds after which no run is repeated
TRIES = 3
_AGAIN = 20_000.0  # values a second that are published again, at least
FLAT = 1.2  # ratio of the dearest to the cheapest value

# About 19,840 changing values a second, in reads of 62 values: only the size differs.
_TAGS = (
    Scenario(8, 2, 62, every=0.05),
    Scenario(10, 16, 62, every=0.5),
    Scenario(10, 80, 62, every=2.5),
    Scenario(10, 32, 620, every=10.0),
)
_DEVICES = (
    Scenario(1, 1, 480 * 62, every=1.5),
    Scenario(10, 1, 32 * 62, every=1.0),
    Scenario(10, 10, 3 * 62, every=0.9375),
    Scenario(10, 100, 62, every=3.125),
)
_TINY = (Scenario(1, 1, 62, every=0.1), Scenario(1, 2, 62, every=0.2))
_LARGE = start.Sizes(64, 32, 100)


class Bench:
    """Measures, and repeats what was measured on a loaded machine."""

    def __init__(self, *, tiny: bool) -> None:
        self._tiny = tiny
        self._until = time.monotonic() + (0.0 if tiny else WITHIN)

    def quietest(self, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Returns the run with the least other work, of three at most."""
        found: list[dict[str, Any]] = []
        while not found or (
            found[-1]["loaded"] and len(found) < TRIES and time.monotonic() < self._until
        ):
            found.append(measure())
            print(json.dumps(found[-1]), file=sys.stderr, flush=True)
        least = min(found, key=lambda one: float(one["load"]["others"]))
        return {**least, "tries": len(found)}

    def gateway(self, slave: Path, scenario: Scenario, *, changing: bool) -> dict[str, Any]:
        # All values are published again for a new client, twice.
        settle = scenarios.SETTLE + scenario.all_tags / _AGAIN
        times = Times(max(10.0, 2 * scenario.every), 20.0, settle)
        if self._tiny:
            times = Times(0.3, 20.0, 0.3)
        return self.quietest(
            lambda: scenarios.measured(scenario, changing=changing, slave=slave, times=times)
        )

    def single(self, measure: Callable[[], float]) -> dict[str, Any]:
        """Measures one figure."""

        def once() -> dict[str, Any]:
            load, before = Load(), os.times()
            value, after = measure(), os.times()
            own = sum(after[:4]) - sum(before[:4])
            machine = load.end(own)
            loaded = machine["others"] > scenarios.QUIET
            return {"value": round(value, 3), "load": machine, "loaded": loaded}

        return self.quietest(once)


@contextmanager
def _one_core() -> Iterator[None]:
    before = os.sched_getaffinity(0)
    transactions.on_one_core()
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def read_beside_pymodbus(folder: Path, count: int) -> float:
    """Returns the processor time of a read, as a share of pymodbus's; NaN without libmodbus."""
    with _one_core():
        found = transactions.modbus_tcp(folder, count, 3)
    if found is None:
        return float("nan")
    return found["ours, 64 tags, uvloop"] / found["pymodbus client"]


def check_of(folder: Path, sizes: start.Sizes) -> float:
    path = folder / "large.yaml"
    path.write_text("\n".join(start.rows(sizes, free_endpoint(), alike=True)) + "\n")
    return start.checked(scenarios.HERE, path).processor


def run(*, tiny: bool) -> dict[str, Any]:
    bench = Bench(tiny=tiny)
    whole = _TINY[0] if tiny else scenarios.SCENARIOS["100k"]
    tags, devices = (_TINY, _TINY) if tiny else (_TAGS, _DEVICES)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        slave = scenarios.compiled(folder)
        return {
            "machine": scenarios.machine(),
            "scenarios": [bench.gateway(slave, whole, changing=one) for one in (False, True)],
            "tags": [bench.gateway(slave, one, changing=True) for one in tags],
            "devices": [
                {**bench.gateway(slave, one, changing=True), "devices": one.lines * one.units}
                for one in devices
            ],
            "single": {
                "read": bench.single(lambda: read_beside_pymodbus(folder, 2 if tiny else 2000)),
                "plan": bench.single(
                    lambda: planning.took("one row", 100 if tiny else 10_000, [0.5, 1.0, 5.0])
                ),
                "check": bench.single(
                    lambda: check_of(folder, start.Sizes(1, 2, 5) if tiny else _LARGE)
                ),
            },
        }


# -- the tables ------------------------------------------------------------------------------------


class Row(NamedTuple):
    name: str
    aim: float
    value: float
    of: list[dict[str, Any]]  # the runs


def _ratio(runs: list[dict[str, Any]]) -> float:
    each = [float(one["us_per_value"]) for one in runs]
    return max(each) / (min(each) or math.inf)  # a tiny run may take no tick of the clock


def _kilobytes(runs: list[dict[str, Any]]) -> float:
    """Returns the memory of a tag."""
    least, most = runs[0], runs[-1]
    tags = max(1, int(most["tags"] - least["tags"]))
    return 1024 * float(most["MB"] - least["MB"]) / tags


def rows(found: dict[str, Any]) -> list[Row]:
    whole = {one["changing"]: one for one in found["scenarios"]}
    single, tags, devices = found["single"], found["tags"], found["devices"]
    own = {
        "a read of 64 tags, x pymodbus": (0.5, "read"),
        "a plan of 10,000 registers, s": (2.0, "plan"),
        "`check` of 204,800 equal tags, s": (5.1, "check"),
    }
    return [
        *(
            Row(
                f"100,000: {aim.name}", aim.most, aim.of(whole[aim.changing]), [whole[aim.changing]]
            )
            for aim in scenarios.AIMS
        ),
        Row("cost of a value, 1,000 to 198,400 tags, most / least", FLAT, _ratio(tags), tags),
        Row("cost of a value, 1 to 1,000 devices, most / least", FLAT, _ratio(devices), devices),
        Row("memory of a tag, kB", 1.0, _kilobytes(tags), tags),
        Row("start of 198,400 tags: s of processor", 5, tags[-1]["start"]["processor"], tags[-1:]),
        *(Row(name, aim, single[key]["value"], [single[key]]) for name, (aim, key) in own.items()),
    ]


def table(found: dict[str, Any]) -> str:
    """Returns the table of the aims."""
    m = found["machine"]
    made = [
        f"{m['date']}, commit {m['commit']}, {m['cores']} cores of {m['processor']},",
        f"{m['system']}, Python {m['python']}, Zenoh {m['zenoh']}.",
        "",
        "| | aim | measured | |",
        "|---|---|---|---|",
    ]
    for row in rows(found):
        words = ["met" if row.value <= row.aim else "missed"]
        if loaded := [one for one in row.of if one["loaded"]]:
            others = max(one["load"]["others"] for one in loaded)
            words.append(f"loaded: others used {others} cores")
        made.append(f"| {row.name} | {row.aim:g} | {row.value:.3g} | {'; '.join(words)} |")
    return "\n".join(made)


def growth(found: dict[str, Any]) -> str:
    """Returns the table of the runs of growing gateways."""
    made = [
        "| tags | devices | at | us each | cores | MB | start, s of processor | missing | wrong |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for one in (*found["tags"], *found["devices"]):
        every, values = one["tags"] / one["per_second"], one["values"]
        devices = f"{one['devices']:,}" if "devices" in one else ""
        start_, wrong = one["start"]["processor"], scenarios.wrong(one)
        made.append(
            f"| {one['tags']:,} | {devices} | {every:.3g} s | {one['us_per_value']:.1f} "
            f"| {one['cores']:.2f} | {one['MB']} | {start_:.1f} | {values['missing']:,} | {wrong} |"
        )
    return "\n".join(made)


def plot(found: dict[str, Any]) -> str:
    each = [
        drawing.Curve(
            "Processor time of a value, us",
            name,
            [(one[name], one["us_per_value"]) for one in found[name]],
            FLAT,
        )
        for name in ("tags", "devices")
    ]
    return drawing.curves(each)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="the file for the result")
    parser.add_argument("--docs", action="store_true", help="write the page from the kept result")
    parser.add_argument("--tiny", action="store_true", help="the smallest sizes: a test")
    arguments = parser.parse_args()
    if arguments.docs:
        kept = json.loads(RESULTS.read_text())
        scenarios.into_page(PAGE, {"aims": table(kept), "growth": growth(kept)})
        DRAWING.write_text(plot(kept))
        return
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    found = run(tiny=arguments.tiny)
    print(f"{table(found)}\n\n{growth(found)}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
