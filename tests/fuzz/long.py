"""Fuzzes every parser for long: `python -m tests.fuzz.long --minutes 40 [NAME...]`.

atheris leads libFuzzer by the branches that an input reaches (`pip install atheris`, Linux). The
corpus of each parser is `tests/fuzz/corpus/<name>`, a line of hexadecimal digits for each input,
and is kept: what a run finds new goes into it, as few inputs as reach all branches.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import structlog

CORPUS = Path(__file__).parent / "corpus"
LONGEST = 4096  # bytes of an input that is kept


def kept(name: str) -> list[bytes]:
    """Returns the corpus of a parser."""
    file = CORPUS / name
    return [bytes.fromhex(line) for line in file.read_text().split()] if file.exists() else []


def one(name: str, arguments: Sequence[str]) -> None:
    """Fuzzes one parser; libFuzzer ends the process."""
    atheris = import_module("atheris")  # installed by hand, and typed nowhere

    with atheris.instrument_imports(include=["gateway", "json"]):
        from tests.fuzz.parsers import PARSERS
    atheris.Setup([sys.argv[0], *arguments], PARSERS[name])
    atheris.Fuzz()


def run(name: str, seconds: int) -> str:
    """Fuzzes, keeps the corpus, and returns a line about it. Raises `SystemExit` for a finding."""
    from tests.fuzz.parsers import PARSERS, SEEDS

    with tempfile.TemporaryDirectory(prefix="fuzz-") as made:
        grown = Path(made, "grown")
        grown.mkdir()
        for number, data in enumerate([*SEEDS[name], *kept(name)]):
            (grown / str(number)).write_bytes(data)
        done = subprocess.run(
            [
                *(sys.executable, "-m", "tests.fuzz.long", "--one", name, str(grown)),
                *(f"-max_total_time={seconds}", f"-max_len={LONGEST}", "-rss_limit_mb=2048"),
                *("-timeout=60", f"-artifact_prefix={made}/"),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            found = [path.read_bytes().hex() for path in Path(made).iterdir() if path.is_file()]
            sys.exit(f"{name}: {done.stdout[-2000:]}{done.stderr[-4000:]}\ninput: {found}")
        inputs = least(PARSERS[name], [path.read_bytes() for path in grown.iterdir()])
    CORPUS.mkdir(exist_ok=True)
    (CORPUS / name).write_text("".join(f"{data.hex()}\n" for data in inputs if data))
    runs = re.findall(r"Done (\d+) runs", done.stderr)
    branches = re.findall(r"cov: (\d+)", done.stderr)
    return f"{name}: {runs[-1]} inputs, {branches[-1]} branches, {len(inputs)} kept"


def least(parser: Callable[[bytes], None], inputs: Iterable[bytes]) -> list[bytes]:
    """Returns the inputs, the shortest first, that go from a line to another one for the first
    time."""
    known, found, last = set[tuple[object, int, int]](), list[bytes](), {"line": 0}

    def trace(frame: FrameType, _event: str, _argument: object) -> Any:
        if "/gateway/" not in frame.f_code.co_filename:
            return None
        seen.add((frame.f_code, last["line"], frame.f_lineno))
        last["line"] = frame.f_lineno
        return trace

    for data in sorted(inputs, key=lambda one: (len(one), one)):
        seen = set[tuple[object, int, int]]()
        sys.settrace(trace)
        try:
            parser(data)
        finally:
            sys.settrace(None)
        if not seen <= known:
            known |= seen
            found.append(data)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--one", action="store_true", help="used by itself")
    parser.add_argument("names", nargs="*")
    options, others = parser.parse_known_args()
    structlog.configure(logger_factory=structlog.ReturnLoggerFactory())
    if options.one:
        one(options.names[0], [*options.names[1:], *others])
    from tests.fuzz.parsers import PARSERS

    names = options.names or [*PARSERS]
    for name in names:
        print(run(name, round(60 * options.minutes / len(names))), flush=True)


if __name__ == "__main__":
    main()
