"""Every benchmark runs to its end at a tiny size, and prints its figures."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import bus_use, drawing, performance, scenario_clients, scenarios
from benchmarks.bridges import DOORS
from tests.conftest import lacking, needs
from tests.e2e.processes import PATIENCE, ROOT
from tests.sim.virtual import run_virtual

# Program, its smallest sizes, and a pattern for each row of figures that it must print.
TINY = [
    (
        "bridge_opcua",
        "--tags 20 --rates 40 --seconds 0.5",
        [r"^20 tags: known after [\d.]+ s, all watched", r"^[\d,]+ changes/s offered: .* 0 lost"],
    ),
    (
        "adapters",
        "--count 2 --seconds 0.5",
        [r"^2 adapters, timer 16 ms: [\d.]+ of a core, \d+ MB, [\d.]+ polls/s, \d+ ms each"],
    ),
    (
        "archive",
        "--samples 2000 --gateways 8 --history 2000 --seconds 1 --store parquet",
        [
            r"^before the back-fill: \d+ live values, late by p50 \d+ ms, p99 \d+ ms$",
            r"^back-fill: 2000 samples, [\d,]+ a second$",
            r"^  daily means of the tags of one gateway: \d+ rows in [\d.]+ s$",
        ],
    ),
    (
        "bus_use",
        "--seconds 0.3 --protocols vigor --bauds 115200",
        [r"^vigor +115200 +\d+ +[\d.]+% +[\d.]+ ms"],
    ),
    (
        "bridges",
        "--tags 50 --rates 200 --seconds 0.2",
        [rf"^\| {door} \| \d+ \| \d+ \| \d+% \| [\d.]+ s \| 0 \| \d+ \|$" for door in DOORS],
    ),
    ("commands", "--calls 1", [r"^\| `check` \| \d+ \|$", r"^\| `run` \| \d+ \|$"]),
    ("encodings", "", [r"^\| a value \| 68 \| 57 \(84%\) \|"]),
    (
        "fleet",
        "--gateways 4 --processes 2 --back 10",
        [
            r"^4 of 4 gateways in [\d.]+ s",
            r"^files that differ: 1 named, 0 ",
            r"^checked: 4 good",
            r"^a change on all: 4 confirmed",
            r"^a bad file on all: given in [\d.]+ s, 4 are back",
            r"^the router is back: (\d) run the new file, \1 were said to",
            r"killed: 2 missing",
        ],
    ),
    ("frames_noise", "0.07", [r"^gap +CR +[\d.]+ +[\d.]+ +[\d.]+$"]),
    (
        "history",
        "--seconds 0.1 --samples 2000 --tags 100",
        [r"^ +100 +2,000 +all +\d+ +[\d.]+ +[\d,]+"],
    ),
    (
        "history_queries",
        "--samples 2000 --rounds 1 --queries 2 --missed 200 --tags 400",
        [r"^catch_up of 200 samples", r"^get plant/\*\* beside three readers: p50 [\d.]+ ms"],
    ),
    ("idle_remote", "--seconds 0.5 --pairs 1", [r"^ratio: [\d.]+ \("]),
    (
        "many_lines",
        "--seconds 6 --lines 2",
        [r"^ +2 lines x 32 .* us of CPU per sample", r"^ +6250 tags in memory: +[\d.]+ MB"],
    ),
    (
        "noise",
        "--seconds 1 --protocols Vigor --losses 25",
        [r"^\| Vigor \| 8 \| 25 % \| [\d.]+ \| [\d.]+ \| [\d.]+ \| [\d.]+ \| 0 \|$"],
    ),
    (
        "northbound",
        "--tags 200 --devices 2 --seconds 0.1 --flood 0.1",
        [
            r"^bare loop of put and nothing else: [\d,]+/s put",
            r"^gateway, from mirror to put: [\d,]+/s put",
            r"^gateway, blocks: only: [\d,]+/s put",
            r"^0\.1 s of flood \+ ask: event loop late",
            r"^2 devices: [\d,]+/s arrived",
        ],
    ),
    ("overload", "--reads 20 --rounds 1", [r"^  now +1: +\d+ +10: +\d+"]),
    ("peers", "requests --seconds 4", [r"^\| this gateway, measured \| 6 \| [\d.]+ \| "]),
    (
        "peers",
        "mute processor --seconds 0.2 --count 2 --rounds 1",
        [r"^\| this gateway \| 0\.5 s \| [\d.]+ \| [\d.]+ s \| measured", r"^## processor"],
    ),
    ("peers_requests", "", [r"^\| \*\*this planner\*\* \| \d+ requests, [\d.]+ s"]),
    (
        "planning",
        "--registers 200",
        [r"^\| every third \| 3 \| [\d.]+ \| ", r"^\| 40 \| 6 \| [\d.]"],
    ),
    (
        "plant",
        "--gateways 2 --lines 1 --devices 1 --tags 3 --steady 1 --settle 1 --patience 20",
        [r"^wrong values shown as good: 0;", r"^\| active gateway of a pair \| [\d.]+ s"],
    ),
    (
        "reload",
        "--lines 2 --reloads 2 --rounds 1",
        [r"^\d+ writes to the other lines, \d+ failed", r"^keys as in the file: True"],
    ),
    ("returns", "--returns 1", [r"^\| now \| 19200 \| 30\.0 \| [\d.]+ \| [\d.]+ \| [\d.]+"]),
    (
        "routers",
        "--rounds 1 --modes client --dead 0.5 --back 0.5",
        [r"^\| client \| 2 \| 1 \| [01] \| [01] \| [01] \| [01] \|$"],
    ),
    (
        "device_servers",
        "--count 3 --seconds 0.1",
        [r"^3 device servers polled", r"within [0-9.]+ s$"],
    ),
    ("served", "--seconds 0.5", [r"^served-1: \d+ replies, \d+ lost: median", r"^a written value"]),
    ("sim_speed", "--minutes 0.05", [r"^every +30 s: +[\d.]+ simulated hours per minute"]),
    (
        "slow_link",
        "--mbit 0 --samples 2000 --seconds 0.5",
        [r"^alarm beside an answer: \d+ arrived, ", r"^samples of the past .* answer: [1-9]"],
    ),
    ("start", "--sizes 1 2 5", [r"^\| different \| run: 10 tags answer in [\d.]+ s \| [\d.]+"]),
    ("transactions", "--count 2 --rounds 1", [r"^  ours, 64 tags, uvloop +[\d.]+"]),
    ("upstream", "wildcards --seconds 1", [r"^after 1 s: \d+ MB$"]),
    (
        "web",
        "--seconds 0.2 --rounds 1 --lines 1",
        [r"^the lines take [\d.]+% of a processor", r"^one scrape: [\d.]+ MB"],
    ),
]
PICTURES = ["pictures", "--after", "0", "--plants", "many", "--sizes", "phone"]
PICTURES += ["--schemes", "light", "--into"]
BY_OTHER_TESTS = {
    "performance",
    "moves",
    "structure",
    "schemas",
    "contract_reader",
    "scenarios",
}  # test_structure, _schemas
PARTS_OF_OTHERS = {
    "__init__",
    "checkouts",
    "drawing",
    "northbound_clients",
    "paced_wire",
    "plant_consumer",
    "scenario_clients",
    "scenario_peer",
    "words",
}


def printed(program: str, *arguments: str) -> str:
    command = [sys.executable, "-m", f"benchmarks.{program}", *arguments]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(("program", "arguments", "figures"), TINY, ids=[row[0] for row in TINY])
def test_a_benchmark_prints_its_figures(program: str, arguments: str, figures: list[str]) -> None:
    text = printed(program, *arguments.split())
    for pattern in figures:
        assert re.search(pattern, text, re.MULTILINE), f"no {pattern!r} in:\n{text}"


def test_the_pictures_of_the_page_are_made(tmp_path: Path) -> None:
    printed(*PICTURES, str(tmp_path), "--chromium", needs("chromium"))
    assert [path for path in tmp_path.iterdir() if path.suffix == ".png"]


def test_the_scenarios_check_every_value(tmp_path: Path) -> None:
    needs("cc")
    result = tmp_path / "result.json"
    sizes = ["--sizes", "1", "1", "4", "0.1", "--values", "change"]
    brief = ["--seconds", "0.3", "--settle", "0.3", "--peers", "--json", str(result)]
    text = printed("scenarios", *sizes, *brief)
    assert re.search(r"^\| pymodbus's asyncio client \| 4 at 100 ms .* change", text, re.MULTILINE)
    assert re.search(r"^\| 4 at 100 ms \(1 × 1 × 4\) \| change", text, re.MULTILINE)
    (one,) = json.loads(result.read_text())["scenarios"]
    values = one["values"]
    assert values["arrived"] + values["missing"] == values["read"] > 0
    assert values["arrived"] > 0
    assert values["wrong"] == values["out of order"] == one["writes"]["lost"] == 0


def test_the_page_has_the_kept_scenarios() -> None:
    kept, page = json.loads(scenarios.RESULTS.read_text()), scenarios.PAGE.read_text()
    assert scenarios.table(kept) in page
    assert scenarios.aims(kept) in page
    assert scenarios.peers(kept) in page


def test_the_gateway_is_measured_against_its_aims(tmp_path: Path) -> None:
    needs("cc")
    text = printed("performance", "--tiny", "--json", str(tmp_path / "result.json"))
    found = json.loads((tmp_path / "result.json").read_text())
    for row in performance.rows(found):
        assert f"| {row.name} | {row.aim:g} | " in text
    for name in ("wrong, or a write lost", "missing of 1,000"):
        assert re.search(rf"^\| 100,000: {name} \| 0 \| 0 \| met", text, re.MULTILINE), text


def test_the_page_has_the_kept_figures() -> None:
    kept, page = json.loads(performance.RESULTS.read_text()), performance.PAGE.read_text()
    assert performance.table(kept) in page
    assert performance.growth(kept) in page
    assert performance.DRAWING.read_text() == performance.plot(kept)


def test_stacks_become_a_flame_graph() -> None:
    svg = drawing.flames("Runner.run (r.py:1);Line.run (l.py:2) 98\nThread.run (t.py:3) 2\n", "Now")
    assert re.findall("<title>(.*)</title>", svg) == ["Line.run: 98.0%", "Thread.run: 2.0%"]


def test_the_consumer_finds_what_is_wrong() -> None:
    token = 5 << 14 | 1234
    right = token ^ (1234 * 40503 & 0xFFFF) << 16
    assert scenario_clients.in_uint32(right, 5) == 1234
    assert scenario_clients.in_uint32(right, 6) is None
    assert scenario_clients.in_uint32(right + 1, 5) is None  # halves of two replies


def test_the_doors_are_measured() -> None:
    for program in ("gcc", "mbpoll", "pkg-config"):
        needs(program)
    if subprocess.run(["pkg-config", "--exists", "libmodbus"], check=False).returncode:
        lacking("libmodbus-dev is not installed")
    text = printed("doors", "--seconds", "0.3", "--programs", "mbpoll")
    assert re.search(r"^mbpoll .* polls +\d+, .* lost", text, re.MULTILINE), text


def test_every_benchmark_is_run() -> None:
    found = {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
    assert found == {
        *(row[0] for row in TINY),
        "pictures",
        "doors",
        *BY_OTHER_TESTS,
        *PARTS_OF_OTHERS,
    }


@pytest.mark.parametrize(
    ("kind", "most"), [(bus_use.SETS[0], 1.01), (bus_use.SETS[1], 1.01), (bus_use.SETS[2], 1.016)]
)
def test_the_order_of_the_blocks_costs_one_percent_of_the_wire(kind: str, most: float) -> None:
    """Of the third set, more than a third of the blocks have one shape: 1.014 is the least."""
    _, took, least = run_virtual(bus_use.round_of(kind, 30.0))
    assert took <= most * least
