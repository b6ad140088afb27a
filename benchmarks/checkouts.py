"""Runs a benchmark with the gateway of another checkout."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def run_in(tree: Path, program: str, arguments: Sequence[str]) -> list[list[str]]:
    """Returns the words of each line that one round prints, with the gateway of that checkout."""
    known = {**os.environ, "PYTHONPATH": str(tree)}
    command = [sys.executable, program, "--once", *arguments]
    done = subprocess.run(
        command, cwd=tree, env=known, check=True, stdout=subprocess.PIPE, text=True
    )
    return [line.split() for line in done.stdout.splitlines()]
