"""The scenarios that other gateways publish, with every value checked: `make scenarios`.

For each scenario it starts the slaves (`scenario_slave.c`, one process), a gateway, a consumer and
a writer (`scenario_clients`). The slaves keep their values, or change all of them with each reply.
It measures the gateway's processor time and memory by /proc, so other work on the machine disturbs
little, and says how much there was. `--json` keeps the result with machine, commit and load;
`--table` prints the table of such a file, and `--docs` writes it into the page.
"""

import argparse
import json
import os
import platform
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.transactions import has_modbus_serial
from tests.zenoh_peer import free_endpoint, free_port

HERE = Path(__file__).parents[1]
PAGE = HERE / "docs" / "scenarios.md"
RESULTS = HERE / "benchmarks" / "results" / "scenarios.json"
# Seconds from the first values of all tags to the measurement. When a client connects, all values
# are published again after 0.3 s, and after 5 s more.
SETTLE = 15.0
DRAIN = 1.5  # seconds after it, for what is still on its way
PATIENCE = 180.0  # seconds for the first values
QUIET = 0.1  # cores that other programs may use in a quiet run
TREE = Path(os.environ.get("GATEWAY_TREE", HERE))  # another checkout, to compare
PYTHON = os.environ.get("GATEWAY_PYTHON", sys.executable)  # another Python for the gateway
TICKS = os.sysconf("SC_CLK_TCK")


class Scenario(NamedTuple):
    lines: int
    units: int  # slaves of a line
    tags: int  # of a slave
    every: float = 1.0
    baud: int = 0  # of Modbus RTU; 0: Modbus TCP
    kind: str = "uint32"
    blocks: str = "false"

    @property
    def all_tags(self) -> int:
        return self.lines * self.units * self.tags

    @property
    def name(self) -> str:
        every = f"{self.every:g} s" if self.every >= 1 else f"{self.every * 1000:g} ms"
        form = f", blocks: {self.blocks}" if self.blocks != "false" else ""
        wire = f", RTU at {self.baud} baud" if self.baud else ""
        kind = "" if self.kind == "uint32" else f" {self.kind}"
        sizes = f"{self.lines} × {self.units} × {self.tags:,}"
        return f"{self.all_tags:,}{kind} at {every} ({sizes}{wire}{form})"


SCENARIOS = {
    "1k": Scenario(10, 10, 10),
    "10k": Scenario(10, 10, 100),
    "100k": Scenario(10, 10, 1000),
    "fast": Scenario(10, 10, 100, every=0.1),
    "one": Scenario(1, 1, 1000),
    "rtu": Scenario(64, 4, 50, baud=19200),
    "over": Scenario(10, 10, 1000, every=0.5),
    "blocks": Scenario(10, 10, 1000, blocks="only"),
}
CHANGING_ONLY = {SCENARIOS["over"], SCENARIOS["blocks"]}


def file(scenario: Scenario, endpoint: str, port: int) -> Iterator[str]:
    """Yields the rows of the gateway's file."""
    yield from ("gateway: {name: bench}", f"zenoh: {{listen: [{endpoint}], refresh: 364d}}")
    defaults = f"every: {scenario.every * 1000:g}ms, type: {scenario.kind}, word_order: high_first"
    yield from (f"defaults: {{{defaults}}}", "lines:")
    for line in range(scenario.lines):
        yield f"  line{line}:\n    port: tcp://127.0.0.1:{port + line}"
        if scenario.baud:
            yield f"    baudrate: {scenario.baud}"
        yield "    devices:"
        for unit in range(1, scenario.units + 1):
            protocol = "modbus-rtu" if scenario.baud else "modbus-tcp"
            yield f"      d{line}-{unit}:\n        protocol: {protocol}\n        station: {unit}"
            if scenario.blocks != "false":
                yield f"        blocks: {scenario.blocks}"
            yield "        tags:"
            for tag in range(scenario.tags):
                yield f"          t{tag}: {{address: holding:{2 * tag}}}"
            if unit == 1:
                yield "          w: {address: holding:60000, type: uint16, write: true}"


# -- processes -------------------------------------------------------------------------------------


def compiled(folder: Path) -> Path:
    """Compiles the slaves."""
    program = folder / "slave"
    source = Path(__file__).with_name("scenario_slave.c")
    subprocess.run(["cc", "-O2", str(source), "-o", str(program)], check=True)
    return program


class Program:
    """A process that speaks lines, and its use of the machine."""

    def __init__(self, *command: object, tree: Path = HERE, log: Any = None) -> None:
        self.process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree)},
        )

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def say(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def ask(self, **what: object) -> Any:
        self.say(json.dumps(what))
        if not (found := self.line()):
            raise SystemExit(f"{self.process.args!r} ended")
        return json.loads(found)

    def close(self) -> str:
        """Ends it with its standard input. Returns what it still says."""
        return self.process.communicate()[0].strip()

    def stop(self) -> None:
        self.process.terminate()
        self.process.communicate()

    def used(self) -> float:
        """Seconds of processor time."""
        return used(self.process.pid)


def used(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory(pid: int) -> float:
    """MB in use."""
    rows = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith("VmRSS")) / 1024


class Load:
    """The other work on the machine."""

    def __init__(self) -> None:
        self._running: list[int] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample)
        self._busy = self._machine()
        self._begun = time.monotonic()
        self._thread.start()

    @staticmethod
    def _machine() -> float:
        words = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
        user, nice, system, _, _, irq, softirq, steal = map(int, words[:8])
        return (user + nice + system + irq + softirq + steal) / TICKS

    def _sample(self) -> None:
        while not self._ended.wait(0.1):
            rows = Path("/proc/stat").read_text().splitlines()
            row = next(row for row in rows if row.startswith("procs_running"))
            self._running.append(int(row.split()[1]) - 1)  # without this thread

    def end(self, own: float) -> dict[str, float]:
        """`own`: seconds of processor time of the processes of this benchmark."""
        self._ended.set()
        self._thread.join()
        seconds = time.monotonic() - self._begun
        others = max(0.0, (self._machine() - self._busy - own) / seconds)
        return {
            "others": round(others, 2),
            "run_queue": round(statistics.fmean(self._running or [0]), 2),
        }


# -- one scenario ----------------------------------------------------------------------------------


class Gateways(NamedTuple):
    """The processes of one file: `run --share`."""

    programs: list[Program]

    @property
    def pids(self) -> list[int]:
        return [one.process.pid for one in self.programs]

    def used(self) -> float:
        return sum(one.used() for one in self.programs)

    def stop(self) -> None:
        for one in self.programs:
            one.process.terminate()
        for one in self.programs:
            one.stop()


@contextmanager
def running(
    scenario: Scenario, *, changing: bool, slave: Path, shares: int = 1
) -> Iterator[dict[str, Any]]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path, record, endpoint = folder / "plant.yaml", folder / "record", free_endpoint()
        port = free_port(scenario.lines)
        path.write_text("\n".join(file(scenario, endpoint, port)) + "\n")
        sizes = (scenario.lines, scenario.units, scenario.tags)
        slaves = Program(slave, port, *sizes, scenario.kind, int(changing), scenario.baud, record)
        stack.callback(slaves.stop)
        assert slaves.line() == "ready"
        log = stack.enter_context((folder / "log").open("w"))
        # As an installed gateway has it: otherwise each start compiles 500 modules.
        subprocess.run([PYTHON, "-m", "compileall", "-q", "gateway"], cwd=TREE, check=True)
        begun = time.monotonic()
        command = (PYTHON, "-m", "gateway", "run", path)
        each = [("--share", f"{n + 1}/{shares}") if shares > 1 else () for n in range(shares)]
        gateway = Gateways([Program(*command, *one, tree=TREE, log=log) for one in each])
        stack.callback(gateway.stop)
        while not listens(endpoint):
            if gateway.programs[0].process.poll() is not None:
                raise SystemExit(f"the gateway ended:\n{(folder / 'log').read_text()[-3000:]}")
            time.sleep(0.02)
        consumer = Program(
            sys.executable, "-m", "benchmarks.scenario_clients", "consume", endpoint, *sizes,
            scenario.kind,
        )  # fmt: skip
        stack.callback(consumer.stop)
        assert consumer.line()
        found = {"begun": begun, "slaves": slaves, "gateway": gateway, "consumer": consumer}
        yield {**found, "endpoint": endpoint, "record": record, "log": folder / "log"}


def listens(endpoint: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(endpoint.rpartition(":")[2]))) == 0


def threads(pid: int) -> dict[str, float]:
    """Seconds of processor time by the names of threads."""
    found: dict[str, float] = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        text = (task / "stat").read_text()
        name = text[text.index("(") + 1 : text.rindex(")")]
        name = "main" if task.name == str(pid) else name
        fields = text.rpartition(")")[2].split()
        found[name] = found.get(name, 0.0) + (int(fields[11]) + int(fields[12])) / TICKS
    return found


class Times(NamedTuple):
    seconds: float
    rate: float  # writes a second
    settle: float


def measured(
    scenario: Scenario,
    *,
    changing: bool,
    slave: Path,
    times: Times,
    spy: str = "",
    shares: int = 1,
) -> dict[str, Any]:
    seconds = times.seconds
    with running(scenario, changing=changing, slave=slave, shares=shares) as parts:
        gateway, consumer, slaves = parts["gateway"], parts["consumer"], parts["slaves"]
        first = consumer.ask(do="wait", within=PATIENCE)["at"]
        if first is None:
            raise SystemExit(f"not all tags have a value:\n{parts['log'].read_text()[-3000:]}")
        start = {"seconds": first - parts["begun"], "processor": gateway.used()}
        writer = Program(
            sys.executable, "-m", "benchmarks.scenario_clients", "write", parts["endpoint"],
            scenario.lines, seconds, times.rate,
        )  # fmt: skip
        assert writer.line() == "ready"
        time.sleep(times.settle)
        consumer.ask(do="keep")
        own = [*gateway.programs, consumer, slaves, writer]
        writer.say("")
        begin, load, before = time.monotonic(), Load(), sum(one.used() for one in own)
        spent, by_thread = gateway.used(), threads(gateway.pids[0])
        each = [one.used() for one in gateway.programs]
        if spy:
            form = ["-f", "raw"] if spy.endswith(".txt") else []
            spied = ["py-spy", "record", *form, "-g", "-r", "300", "-d", str(int(seconds)), "-p"]
            subprocess.run([*spied, str(gateway.pids[0]), "-o", spy], check=True)
        time.sleep(max(0.0, begin + seconds - time.monotonic()))
        end = time.monotonic()
        spent = gateway.used() - spent
        each = [one.used() - at for one, at in zip(gateway.programs, each, strict=True)]
        by_name = {
            name: round((one - by_thread.get(name, 0.0)) / (end - begin), 3)
            for name, one in threads(gateway.pids[0]).items()
        }
        machine = load.end(sum(one.used() for one in own) - before)
        size = sum(map(memory, gateway.pids))
        writes = json.loads(writer.line())
        writer.close()
        time.sleep(min(DRAIN, times.settle))
        gateway.stop()
        count, total = map(int, slaves.close().split())
        values = consumer.ask(
            do="check", record=str(parts["record"]), begin=begin, end=end,
            late=max(1.0, scenario.every), changing=changing,
        )  # fmt: skip
        writes["lost"] = abs(writes["writes"] - count) + (writes.pop("sum") != total)
    return {
        "name": scenario.name,
        "changing": changing,
        "tags": scenario.all_tags,
        "per_second": scenario.all_tags / scenario.every,
        "cores": round(spent / (end - begin), 3),
        "cores of each": [round(one / (end - begin), 3) for one in each],
        "threads": {name: share for name, share in by_name.items() if share >= 0.01},
        "us_per_value": round(spent / max(1, values["arrived"]) * 1e6, 2) if changing else None,
        "MB": round(size),
        "start": {name: round(one, 2) for name, one in start.items()},
        "values": values,
        "writes": writes,
        "load": machine,
        "loaded": machine["others"] > QUIET,
    }


# -- peers -----------------------------------------------------------------------------------------


MODBUS_SERIAL = "npm's modbus-serial"
PEERS = {
    "pymodbus's asyncio client": (sys.executable, "-m", "benchmarks.scenario_peer"),
    MODBUS_SERIAL: ("node", HERE / "benchmarks" / "scenario_peer.js"),
}


def measured_peer(
    name: str, scenario: Scenario, *, changing: bool, slave: Path, times: Times
) -> dict[str, Any]:
    """Measures another program that reads the same slaves, and publishes nothing."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        port, sizes = free_port(scenario.lines), (scenario.lines, scenario.units, scenario.tags)
        record = Path(folder) / "record"
        slaves = Program(slave, port, *sizes, scenario.kind, int(changing), 0, record)
        stack.callback(slaves.stop)
        assert slaves.line() == "ready"
        peer = Program(*PEERS[name], port, *sizes, scenario.every)
        stack.callback(peer.stop)
        time.sleep(times.settle)
        begin, load, before = time.monotonic(), Load(), peer.used() + slaves.used()
        first, spent = peer.ask(), peer.used()
        time.sleep(times.seconds)
        last, spent, seconds = peer.ask(), peer.used() - spent, time.monotonic() - begin
        machine = load.end(peer.used() + slaves.used() - before)
        return {
            "name": name,
            "scenario": scenario.name,
            "changing": changing,
            "cores": round(spent / seconds, 3),
            "MB": round(memory(peer.process.pid)),
            **{key: round((last[key] - first[key]) / seconds) for key in ("read", "changed")},
            "late": last["late"] - first["late"],
            "load": machine,
            "loaded": machine["others"] > QUIET,
        }


def peers(results: dict[str, Any]) -> str:
    """Returns the table of the peers beside the gateway."""
    rows = [
        "| program | scenario | values | cores | MB | values read/s | late rounds |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in results.get("peers", ()):
        note = f" (others used {one['load']['others']} cores)" if one["loaded"] else ""
        rows.append(
            f"| {one['name']} | {one['scenario']} | {'change' if one['changing'] else 'stay'}{note}"
            f" | {one['cores']:.2f} | {one['MB']} | {one['read']:,} | {one['late']} |"
        )
    return "\n".join(rows)


# -- the table -------------------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    rows = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((row.partition(":")[2].strip() for row in rows if "model name" in row), "")
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=HERE, capture_output=True, text=True,
        check=False,
    ).stdout.strip()  # fmt: skip
    return {
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "commit": commit,
        "cores": os.cpu_count(),
        "processor": model or platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "zenoh": version("eclipse-zenoh"),
    }


def _ms(seconds: float | None) -> str:
    return "" if seconds is None else f"{seconds * 1000:.0f}"


def table(results: dict[str, Any]) -> str:
    """Returns the table of the page."""
    m = results["machine"]
    rows = [
        f"{m['date']}, commit {m['commit']}, {m['cores']} cores of {m['processor']},",
        f"{m['system']}, Python {m['python']}, Zenoh {m['zenoh']}.",
        "",
        (
            "| scenario | values | cores | us each | MB | start, s (of processor) | read "
            "| missing | twice | wrong | delay p50, p99, ms | writes p50, p99, max, ms |"
        ),
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for one in results["scenarios"]:
        values, writes, start = one["values"], one["writes"], one["start"]
        wrongs = wrong(one)
        each = "" if one["us_per_value"] is None else f"{one['us_per_value']:.1f}"
        note = f" (others used {one['load']['others']} cores)" if one["loaded"] else ""
        rows.append(
            f"| {one['name']} | {'change' if one['changing'] else 'stay'}{note} "
            f"| {one['cores']:.2f} | {each} | {one['MB']} "
            f"| {start['seconds']:.1f} ({start['processor']:.1f}) "
            f"| {values['read']:,} | {values['missing']:,} | {values['twice']:,} | {wrongs} "
            f"| {_ms(values['p50'])}, {_ms(values['p99'])} "
            f"| {_ms(writes['p50'])}, {_ms(writes['p99'])}, {_ms(writes['max'])} |"
        )
    return "\n".join(rows)


def _read(one: dict[str, Any]) -> int:
    return max(1, int(one["values"]["read"]))


def wrong(one: dict[str, Any]) -> int:
    found = sum(one["values"][name] for name in ("wrong", "wrong time", "out of order"))
    return int(found + one["writes"]["lost"] + one["writes"]["failed"])


class Aim(NamedTuple):
    """A figure of 100,000 values, and its greatest value on two quiet cores."""

    name: str
    changing: bool
    most: float
    of: Callable[[dict[str, Any]], float]


AIMS = (
    Aim("values stay: cores", False, 0.10, lambda one: one["cores"]),
    Aim("values stay: MB", False, 160, lambda one: one["MB"]),
    Aim("start: s of processor", False, 5, lambda one: one["start"]["processor"]),
    Aim("values change: cores", True, 0.8, lambda one: one["cores"]),
    Aim("missing of 1,000", True, 0, lambda one: 1000 * one["values"]["missing"] / _read(one)),
    Aim("wrong, or a write lost", True, 0, wrong),
    Aim("writes beside it: p99, ms", True, 20, lambda one: 1000 * one["writes"]["p99"]),
)


def aims(results: dict[str, Any]) -> str:
    """Returns the table of the aims, without rows that the results have not."""
    rows = ["| 100,000 values at 1 s | aim | measured | |", "|---|---|---|---|"]
    name = SCENARIOS["100k"].name
    found = {one["changing"]: one for one in results["scenarios"] if one["name"] == name}
    for aim in AIMS:
        if (one := found.get(aim.changing)) is None:
            continue
        value, load = aim.of(one), one["load"]
        words = ["met" if value <= aim.most else "missed"]
        if one["loaded"]:
            queue = load["run_queue"]
            words += [f"others used {load['others']} cores, {queue:.0f} programs ran or waited"]
        rows.append(f"| {aim.name} | {aim.most:g} | {value:.4g} | {'; '.join(words)} |")
    return "\n".join(rows)


def into_page(page: Path, tables: Mapping[str, str]) -> None:
    """Writes tables between their marks."""
    text = page.read_text()
    for mark, made in tables.items():
        before, rest = text.split(f"<!-- {mark} -->")
        after = rest.split(f"<!-- end of {mark} -->")[1]
        text = f"{before}<!-- {mark} -->\n{made}\n<!-- end of {mark} -->{after}"
    page.write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("only", nargs="*", choices=[[], *SCENARIOS], help="scenarios")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=20.0, help="writes a second")
    parser.add_argument("--settle", type=float, default=SETTLE, help="seconds before it")
    parser.add_argument("--values", choices=("stay", "change", "both"), default="both")
    parser.add_argument("--kind", choices=("uint32", "float32"), default="uint32")
    parser.add_argument("--blocks", choices=("false", "true", "only"), default="false")
    parser.add_argument("--sizes", type=float, nargs=4, help="lines, units, tags, seconds")
    parser.add_argument("--json", type=Path, help="the file for the result")
    parser.add_argument("--table", type=Path, help="print the table of this file")
    parser.add_argument("--docs", action="store_true", help="write the page from the kept result")
    parser.add_argument("--peers", action="store_true", help="100,000 values by other programs")
    parser.add_argument("--shares", type=int, default=1, help="processes of one file")
    parser.add_argument("--spy", default="", help="a flame graph of the gateway (py-spy)")
    arguments = parser.parse_args()
    if arguments.table is not None:
        kept = json.loads(arguments.table.read_text())
        print(f"{table(kept)}\n\n{aims(kept)}\n\n{peers(kept)}")
        return
    if arguments.docs:
        kept = json.loads(RESULTS.read_text())
        into_page(PAGE, {"scenarios": table(kept), "aims": aims(kept), "peers": peers(kept)})
        return
    chosen = [SCENARIOS[name] for name in arguments.only or SCENARIOS]
    if arguments.sizes is not None:
        lines, units, tags, every = arguments.sizes
        chosen = [Scenario(int(lines), int(units), int(tags), every)]
    if arguments.kind != "uint32":
        chosen = [one._replace(kind=arguments.kind) for one in chosen]
    if arguments.blocks != "false":
        chosen = [one._replace(blocks=arguments.blocks) for one in chosen]
    changes = {"stay": [False], "change": [True], "both": [False, True]}[arguments.values]
    times = Times(arguments.seconds, arguments.rate, arguments.settle)
    results: dict[str, Any] = {"machine": machine(), "scenarios": []}
    with tempfile.TemporaryDirectory() as folder:
        slave = compiled(Path(folder))
        for scenario in chosen:
            for changing in [True] if scenario in CHANGING_ONLY else changes:
                one = measured(
                    scenario,
                    changing=changing,
                    slave=slave,
                    times=times,
                    spy=arguments.spy,
                    shares=arguments.shares,
                )
                print(json.dumps(one), file=sys.stderr, flush=True)
                results["scenarios"].append(one)
        results["peers"] = [
            measured_peer(name, scenario, changing=changing, slave=slave, times=times)
            for name in PEERS
            if arguments.peers and (name != MODBUS_SERIAL or has_modbus_serial())
            for scenario in chosen
            if arguments.sizes is not None or scenario == SCENARIOS["100k"]
            for changing in changes
        ]
    print(f"{table(results)}\n\n{aims(results)}\n\n{peers(results)}")
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
