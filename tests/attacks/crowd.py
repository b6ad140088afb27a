"""Many connections to the page of a gateway that runs: `python -m tests.attacks.crowd 10000`.

Most send nothing, some half a request, some ask for much and read nothing. Meanwhile curl asks the
probes, the metrics and the page, and a slow client reads a whole answer.
"""

import argparse
import asyncio
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

from tests.conftest import needs
from tests.e2e.processes import PATIENCE, Program, free_port, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

ASKED = ("/healthz", "/readyz", "/metrics", "/", "/api/status")
HALF = b"GET /api/tags HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: "
MUCH = b"GET /api/tags?limit=1000 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
PIECE = 4096  # bytes that the slow client reads at once


class Seen(NamedTuple):
    """What the gateway did meanwhile."""

    opened: int  # connections
    statuses: dict[str, str]  # of curl, by path
    slowest: float  # seconds of an answer to curl
    whole: bool  # the slow client got its answer
    grown: int  # bytes of memory
    files: int  # file descriptors at the end


async def crowd(port: int, count: int, held: list[asyncio.StreamWriter]) -> int:
    """Opens the connections from many addresses. Returns how many were accepted."""
    opened = 0
    for first in range(0, count, 200):
        found = await asyncio.gather(
            *(_one(port, number) for number in range(first, min(first + 200, count)))
        )
        held += [one for one in found if one is not None]
        opened = len(held)
    return opened


async def _one(port: int, number: int) -> asyncio.StreamWriter | None:
    by = f"127.0.{1 + number // 200 % 250}.{1 + number % 200}"
    with suppress(OSError):
        _, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(by, 0), limit=1024)
        writer.write((b"", HALF, MUCH, b"\0\xff\r\n\r\n")[number % 4])
        return writer
    return None


def curl(program: str, port: int, path: str) -> str:
    """Returns the status and the seconds of an answer. A client asks again after a 503."""
    url = f"http://127.0.0.1:{port}{path}"
    words = ["-s", "-o", "/dev/null", "-w", "%{http_code} %{time_total}", url]
    limit = ["--max-time", str(PATIENCE), "--retry", "9", "--retry-delay", "1"]
    return subprocess.run(
        [program, *limit, *words], capture_output=True, text=True, check=False
    ).stdout


async def slow(port: int) -> bool:
    """Reads an answer of some 100 kB in small pieces. Returns True if it is whole."""
    reader, writer = await asyncio.open_connection(
        "127.0.0.1", port, local_addr=("127.0.0.99", 0), limit=PIECE
    )
    writer.write(MUCH)
    head = await reader.readuntil(b"\r\n\r\n")
    left = int(head.partition(b"Content-Length: ")[2].partition(b"\r\n")[0])
    while left and (data := await reader.read(PIECE)):
        left -= len(data)
        await asyncio.sleep(0.02)
    writer.close()
    return head.startswith(b"HTTP/1.1 200") and not left


def memory(pid: int) -> int:
    """Returns its bytes in memory that no file holds."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("RssAnon:")[2].split()[0]) * 1024


async def attack(gateway: Program, port: int, count: int) -> Seen:
    program, held = needs("curl"), list[asyncio.StreamWriter]()
    before = memory(gateway.pid)
    reading = asyncio.create_task(slow(port))
    opened = await crowd(port, count, held)
    answers = {path: (await asyncio.to_thread(curl, program, port, path)).split() for path in ASKED}
    whole = await reading
    grown = memory(gateway.pid) - before
    files = len([*Path(f"/proc/{gateway.pid}/fd").iterdir()])
    for writer in held:
        writer.transport.abort()
    statuses = {path: status for path, (status, _) in answers.items()}
    slowest = max(float(seconds) for _, seconds in answers.values())
    return Seen(opened, statuses, slowest, whole, grown, files)


def plant(folder: Path, port: int) -> Path:
    tags = {f"t{n}": {"address": f"D{n}"} for n in range(1000)}
    lines = {"hall": vigor_line("simulator", tags)}
    web = {"listen": f"127.0.0.1:{port}"}
    return write_config(folder / "plant.yaml", free_endpoint(), lines, web=web)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=10_000)
    count = parser.parse_args(arguments).count
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        port, begun = free_port(), time.monotonic()
        gateway = stack.enter_context(started(plant(Path(folder), port)))
        gateway.says("web page ready")
        seen = asyncio.run(attack(gateway, port, count))
        print(f"{seen} in {time.monotonic() - begun:.0f} s")
        sys.exit({*seen.statuses.values()} != {"200"} or not seen.whole)


if __name__ == "__main__":
    main()
