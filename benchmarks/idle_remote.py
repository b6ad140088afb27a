"""Processor time of an idle gateway with and without `remote`: `python -m benchmarks.idle_remote`.

Two gateways run at the same time, with ten simulated tags that are read once a second. One has the
section `remote`. The program prints their processor time side by side, and the ratio of each pair:
other work on the machine is the same for both.
"""

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

from tests.e2e.processes import started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TICKS = os.sysconf("SC_CLK_TCK")


def file_of(folder: Path, name: str, **sections: object) -> Path:
    (own := folder / name).mkdir()
    secret = own / "writers.txt"
    secret.write_text(f"ana:{'0' * 32}\n")
    secret.chmod(0o600)
    tags = {f"t{number}": {"address": f"D{number}"} for number in range(10)}
    lines = {"hall": vigor_line("simulator", tags)}
    sections = {"defaults": {"every": "1s"}, "writers": {"file": "writers.txt"}, **sections}
    return write_config(own / "plant.yaml", free_endpoint(), lines, **sections)


def processor_time(pid: int) -> float:
    """Returns the seconds of all threads of a process."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / TICKS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--pairs", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        without = file_of(Path(folder), "without")
        having = file_of(Path(folder), "with", remote={"writers": ["ana"]})
        with started(without) as one, started(having) as other:
            ratios = []
            for _ in range(given.pairs):
                before = [processor_time(program.pid) for program in (one, other)]
                time.sleep(given.seconds)
                after = [processor_time(program.pid) for program in (one, other)]
                spent = [end - begin for begin, end in zip(before, after, strict=True)]
                ratios.append(spent[1] / max(spent[0], 1 / TICKS))
                rates = (f"{1e3 * one / given.seconds:.1f}" for one in spent)
                print(f"without remote {next(rates)} ms/s, with it {next(rates)} ms/s", flush=True)
    print(f"ratio: {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    main()
