"""The processor time of one command: `python -m benchmarks.commands [--before CHECKOUT]`.

It starts a gateway with simulated stations and calls each command some times. It prints the median
of the processor time (user and system) of one call. `--before` names a checkout of another version:
both are called in turn, and the last column is the ratio. `run` is measured until a query of a tag
is answered.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.start import HERE, answers, session
from tests.zenoh_peer import free_endpoint

COMMANDS = (
    *(["version"], ["--help"], ["check", "FILE"], ["status", "FILE"], ["health", "FILE"]),
    *(["health", "--strict", "FILE"], ["alarms", "FILE"], ["read", "FILE"]),
)
TEXT = """\
gateway: {{name: demo}}
zenoh: {{listen: [{endpoint}]}}
lines:
  hall:
    port: simulator
    devices:
      mixer: {{protocol: vigor, station: 1, tags: {{speed: {{address: D10}}}}}}
"""


def started(tree: Path, arguments: list[str]) -> subprocess.Popen[bytes]:
    known = {**os.environ, "PYTHONPATH": str(tree)}
    known.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-m", "gateway", *arguments]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=tree, env=known, stdout=quiet, stderr=quiet)


def ended(program: subprocess.Popen[bytes]) -> float:
    """Returns the milliseconds of processor time. Waits for the end of the program."""
    _, status, used = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    return (used.ru_utime + used.ru_stime) * 1000


def called(tree: Path, arguments: list[str]) -> float:
    program = started(tree, arguments)
    taken = ended(program)
    if program.returncode:
        raise SystemExit(f"{arguments} ended with {program.returncode}")
    return taken


def ran(tree: Path, folder: Path) -> float:
    """Returns the milliseconds of a gateway that ends when it has answered a query."""
    path, endpoint = folder / "run.yaml", free_endpoint()
    path.write_text(TEXT.format(endpoint=endpoint))
    program = started(tree, ["run", str(path)])
    with session(endpoint, float("inf")) as client:
        while not answers(client, "plant/mixer/speed"):
            pass
    program.terminate()
    return ended(program)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=9)
    parser.add_argument("--before", type=Path, help="a checkout of another version")
    arguments = parser.parse_args()
    trees = [HERE]
    if arguments.before is not None:
        trees.insert(0, arguments.before.resolve())
    columns = ["ms"] if len(trees) == 1 else ["ms before", "ms now", "ratio"]
    print(f"| command | {' | '.join(columns)} |")
    print("|---" * (len(columns) + 1) + "|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, endpoint = folder / "plant.yaml", free_endpoint()
        path.write_text(TEXT.format(endpoint=endpoint))
        gateway = started(HERE, ["run", str(path)])
        try:
            with session(endpoint, float("inf")) as client:
                while not answers(client, "plant/mixer/speed"):
                    pass
            for command in COMMANDS:
                words = [str(path) if word == "FILE" else word for word in command]
                calls = [[called(tree, words) for tree in trees] for _ in range(arguments.calls)]
                show(" ".join(command[:-1] if "FILE" in command else command), calls)
            show("run", [[ran(tree, folder) for tree in trees] for _ in range(arguments.calls)])
        finally:
            gateway.terminate()
            gateway.wait()


def show(command: str, calls: list[list[float]]) -> None:
    medians = [statistics.median(tree) for tree in zip(*calls[1:] or calls, strict=True)]
    numbers = [f"{median:.0f}" for median in medians]
    if len(medians) > 1:
        numbers.append(f"{medians[1] / medians[0]:.2f}")
    print(f"| `{command}` | {' | '.join(numbers)} |", flush=True)


if __name__ == "__main__":
    main()
