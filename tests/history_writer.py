"""A process with its own history, for tests that kill it or make its disk fail.

`run PATH`      records a scan of ten samples every 2 ms until it is killed; before each it prints
                how many scans are stored
`full PATH`     records until the file reaches a size limit, then lifts the limit and ends
`readonly PATH` starts with a read-only file, then makes it writable and ends

The last two print a JSON line at the end: the status and the number of scans.
"""

import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import structlog

from gateway.parts.history.historian import Historian
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Publishing, Sample, Tag, good
from gateway.values import Layout, parse_type

WEEK = 7 * 86400.0
NOBODY = 65534


def tag(name: str, *, history: bool = True) -> Tag:
    return Tag(
        device="mixer",
        name=name,
        text="D100",
        address=Address("D", 100),
        span=Span("D", 100, 1),
        unit_kind=Unit.WORD,
        layout=Layout(parse_type("int16")),
        publishing=Publishing(history=history),
    )


TAGS = [tag(f"t{n}") for n in range(10)]


def scan(number: int) -> list[Sample]:
    now = time.time_ns()
    return [good(tag, number, now) for tag in TAGS]


def until(historian: Historian, **wanted: object) -> dict[str, Any]:
    """Waits at most a minute until the status has these values."""
    for _ in range(6000):
        document = dict(historian.document())
        if all(document[name] == value for name, value in wanted.items()):
            return document
        time.sleep(0.01)
    raise TimeoutError(f"never {wanted}: {document}")


def run(historian: Historian) -> None:
    number = 0
    while True:
        number += 1
        print(int(str(historian.document()["stored"])) // len(TAGS), flush=True)
        historian.record(scan(number))
        time.sleep(0.002)


def full(historian: Historian, path: Path) -> None:
    until(historian, state="ok")
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    wal = Path(f"{path}-wal").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (wal + 200_000, most))
    number = 0
    while (trouble := historian.document())["state"] == "ok":
        number += 1
        historian.record(scan(number))
        time.sleep(0.0005)
    longest = 0.0
    for _ in range(200):
        number += 1
        begun = time.perf_counter()
        historian.record(scan(number))
        longest = max(longest, time.perf_counter() - begun)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    after = until(historian, state="ok", waiting=0)
    historian.close()
    print(json.dumps({"trouble": trouble, "after": after, "number": number, "longest": longest}))


def readonly(historian: Historian, path: Path) -> None:
    for _ in range(6000):
        trouble = historian.document()
        if trouble["state"] not in ("ok", "not opened yet"):
            break
        time.sleep(0.01)
    historian.record(scan(1))
    path.chmod(0o644)
    path.parent.chmod(0o755)
    after = until(historian, state="ok", waiting=0)
    historian.close()
    print(json.dumps({"trouble": trouble, "after": after}))


def main() -> None:
    do, path = sys.argv[1], Path(sys.argv[2])
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    if do == "readonly" and os.getuid() == 0:  # root may write in spite of any mode
        os.setuid(NOBODY)
    historian = Historian(path, WEEK, 100_000_000)
    historian.start()
    match do:
        case "run":
            run(historian)
        case "full":
            full(historian, path)
        case "readonly":
            readonly(historian, path)


if __name__ == "__main__":
    main()
