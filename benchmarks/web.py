"""The cost of an open status page: `python -m benchmarks.web`.

It runs a gateway with 64 lines of simulated Vigor stations and 50,000 tags. In turn nothing is
connected, and one page shows a line and a device, for the same time each. It prints the processor
time of the gateway in both, the time of one scrape of /metrics, and with Chromium at hand the time
to the first paint.
"""

import argparse
import asyncio
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from benchmarks.start import HERE, Sizes, rows, started
from tests.e2e.processes import free_port
from tests.web.browser import browser
from tests.zenoh_peer import free_endpoint

SIZES = Sizes(lines=64, devices=8, tags=98)


def processor(process: subprocess.Popen[bytes]) -> float:
    """Seconds of the processor since its start."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def memory(process: subprocess.Popen[bytes]) -> float:
    """MB."""
    text = Path(f"/proc/{process.pid}/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1000


def spent(process: subprocess.Popen[bytes], port: int, seconds: float) -> tuple[float, float]:
    """The share of one processor in the next seconds, and its microseconds for each exchange."""
    exchanges, begun, before = exchanged(port), time.monotonic(), processor(process)
    time.sleep(seconds)
    used, passed = processor(process) - before, time.monotonic() - begun
    return used / passed, used / (exchanged(port) - exchanges) * 1e6


def exchanged(port: int) -> float:
    text = fetched(port, "/metrics").decode()
    name = "plc_gateway_device_exchanges_total{"
    return sum(float(row.split()[-1]) for row in text.splitlines() if row.startswith(name))


def fetched(port: int, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=60) as reply:
        body: bytes = reply.read()
        return body


def until_up(port: int, devices: int) -> None:
    while True:
        try:
            text = fetched(port, "/metrics").decode()
        except OSError:
            text = ""
        if text.count('state="up"} 1.0') == devices:
            return
        time.sleep(1)


async def first_paint(port: int, chromium: str, profile: Path) -> tuple[float, float]:
    """Seconds until something is painted, and until every value of a device is shown."""
    async with browser(chromium, profile) as tab:
        begun = time.monotonic()
        await tab.open(f"http://127.0.0.1:{port}/#line=line0&device=d0-0")
        await tab.until(
            'document.body?.className === "" && document.querySelectorAll("#values tr").length > 90'
        )
        live = time.monotonic() - begun
        paint = await tab.value('performance.getEntriesByName("first-paint")[0].startTime')
        return paint / 1000, live


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each measurement")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        port, path = free_port(), Path(folder) / "plant.yaml"
        text = "\n".join(rows(SIZES, free_endpoint(), alike=True))
        path.write_text(f'web: {{listen: "127.0.0.1:{port}"}}\n{text}\n')
        process = started(HERE, "run", path)
        try:
            measure(process, port, Path(folder), arguments.seconds, arguments.rounds)
        finally:
            process.kill()
            process.wait()


def measure(
    process: subprocess.Popen[bytes], port: int, folder: Path, seconds: float, rounds: int
) -> None:
    until_up(port, SIZES.lines * SIZES.devices)
    print(f"{SIZES.all_tags} tags on {SIZES.lines} lines, {memory(process):.0f} MB", flush=True)
    alone, watched = [], []
    for _ in range(rounds):
        alone.append(spent(process, port, seconds))
        page = f"http://127.0.0.1:{port}/api/events?line=line0&device=d0-0"
        client = [sys.executable, "-c", _READER, page]
        with subprocess.Popen(client, stdout=subprocess.DEVNULL) as reading:
            time.sleep(2)  # the first event is the largest
            watched.append(spent(process, port, seconds))
            reading.kill()
    before, after = (map(statistics.median, zip(*found, strict=True)) for found in (alone, watched))
    shares, costs = zip(before, after, strict=True)
    print("without a page {:.1%} of a processor, with one {:.1%}".format(*shares))
    print(
        "for each exchange {:.0f} and {:.0f} us".format(*costs), f"({costs[1] / costs[0] - 1:+.1%})"
    )
    begun, used = time.monotonic(), processor(process)
    size = len(fetched(port, "/metrics"))
    taken = time.monotonic() - begun
    print(
        f"one scrape: {size / 1e6:.1f} MB in {taken:.2f} s, {processor(process) - used:.2f} s CPU"
    )
    if chromium := shutil.which("chromium"):
        paint, live = asyncio.run(first_paint(port, chromium, folder / "profile"))
        print(f"first paint after {paint:.2f} s, all values live after {live:.2f} s")


_READER = "import sys, urllib.request as u; r = u.urlopen(sys.argv[1])\nwhile r.read1(): pass"

if __name__ == "__main__":
    main()
