"""The cost of an open status page: `python -m benchmarks.web`.

A plant has 64 lines of simulated Vigor stations and 50,000 tags. First its lines run on virtual
time, in turn without a page and with one that shows a line and a device: both do the same work on
the wire, so that the processor times can be compared on a busy computer too. Zenoh is left out:
with it the share of the page is smaller. Then a real gateway runs: one scrape of /metrics, and with
Chromium at hand the time to the first paint.
"""

import argparse
import asyncio
import gc
import logging
import shutil
import statistics
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import structlog

from benchmarks.start import HERE, Sizes, rows, started
from gateway.config import Config, load
from gateway.contract import payload
from gateway.contract.faults import Documents
from gateway.northbound.requests.audit import Counts
from gateway.parts.web.api import Api
from gateway.parts.web.connections import Who
from gateway.parts.web.events import WIRE_EVERY, Events, Page
from gateway.parts.web.line_past import Loads
from gateway.parts.web.tag_list import TagList
from gateway.plant.part import Core
from gateway.plant.plant import Plant
from tests.e2e.processes import free_port
from tests.no_parts import NoParts
from tests.sim.virtual import run_virtual
from tests.web.browser import browser
from tests.web.serving import PlainNorth
from tests.zenoh_peer import free_endpoint

DEVICES, TAGS = 8, 98  # of a line, of a device
PUBLISHED_EVERY = 5.0  # seconds


class North(PlainNorth):
    """Collects the documents as the gateway does: also with their JSON."""

    def __init__(self, gateway: Plant) -> None:
        super().__init__()
        self._gateway = gateway
        self._at = float("-inf")
        self._found: Documents = {}

    async def documents(self, max_age: float) -> Documents:
        now = asyncio.get_running_loop().time()
        if now - self._at > max_age:
            found = dict(self._gateway.status())
            found["status"] = {**found["status"], "refused_devices": {}}
            found |= {"zenoh": {"to": []}, "outcomes": Counts().document()}
            for document in found.values():
                payload.document(document)
            self._at, self._found = now, found
        return self._found

    async def publish(self) -> None:
        while True:
            await self.documents(0.0)
            await asyncio.sleep(PUBLISHED_EVERY)


async def play(gateway: Plant, seconds: float, made: list[float] | None) -> None:
    north = North(gateway)
    tasks = [asyncio.create_task(line.run()) for line in gateway.lines]
    tasks.append(asyncio.create_task(north.publish()))
    if made is not None:
        tasks.append(asyncio.create_task(show(core_of(gateway, north), made)))
    await asyncio.sleep(seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


class Nothing(NoParts):
    """No other part works."""

    def each(self, capability: type[object]) -> list[object]:
        return []


def core_of(gateway: Plant, north: Any) -> Core:
    parts = Nothing()
    return Core(gateway, north, parts.history, parts)


async def show(core: Core, made: list[float]) -> None:
    """Makes the events of one page. Adds the processor time of each to `made`."""
    tags, loads, client = TagList(core.plant, ()), Loads(core), Who("", may_write=False)
    events = Events(core, tags, loads, lambda _: client, Api(core, tags).past)
    measuring = asyncio.create_task(loads.run())
    try:
        with events.wires.watched("line0") as recorder:
            page = Page(core, events, tags.chosen("d0-0/*"), recorder)
            while True:
                begun = time.process_time()  # nothing else runs meanwhile
                await page.next(client)
                made.append(time.process_time() - begun)
                await asyncio.sleep(WIRE_EVERY)
    finally:
        measuring.cancel()


def spent(config: Config, seconds: float, made: list[float] | None) -> tuple[float, int]:
    """Seconds of the processor for so many seconds of the plant, and its exchanges."""
    gateway = Plant(config)
    gc.collect()
    gc.freeze()  # as the service does
    begun = time.process_time()
    run_virtual(play(gateway, seconds, made))
    used = time.process_time() - begun
    gc.unfreeze()
    return used, sum(device.record.exchanges for device in gateway.enabled_devices)


def compare(config: Config, seconds: float, rounds: int) -> None:
    ratios, bases, counts = [], [], set()
    made: list[float] = []
    for _ in range(rounds):
        before, exchanges = spent(config, seconds, None)
        after, with_page = spent(config, seconds, made)
        ratios.append(after / before - 1)
        bases.append(before / seconds)
        counts |= {exchanges, with_page}
    base, events = statistics.median(bases), sum(made) / seconds / rounds
    print(
        f"the lines take {base:.1%} of a processor, the events of a page {events:.2%}: "
        f"{events / base:+.1%}. As a whole: "
        f"{', '.join(f'{ratio:+.1%}' for ratio in ratios)}. Exchanges: {sorted(counts)}. "
        f"The longest event took {max(made) * 1000:.1f} ms",
        flush=True,
    )


def fetched(port: int, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=60) as reply:
        body: bytes = reply.read()
        return body


def processor(process: subprocess.Popen[bytes]) -> float:
    """Seconds of the processor since its start."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def until_up(port: int, devices: int) -> None:
    while True:
        try:
            text = fetched(port, "/metrics").decode()
        except OSError:
            text = ""
        if text.count('state="up"} 1.0') == devices:
            return
        time.sleep(1)


async def first_paint(port: int, chromium: str, profile: Path) -> tuple[float, float, float]:
    """Returns seconds until something is painted and until the values are shown, and the bytes that
    were loaded until then."""
    async with browser(chromium, profile) as tab:
        await tab.open(f"http://127.0.0.1:{port}/#overview")
        for name in ("values", "first-paint"):  # in any order
            await tab.until(f"performance.getEntriesByName('{name}').length > 0")
        paint = await tab.value('performance.getEntriesByName("first-paint")[0].startTime')
        live = await tab.value('performance.getEntriesByName("values")[0].startTime')
        size = await tab.value(
            'performance.getEntries().filter((one) => !one.name.includes("/api/"))'
            ".reduce((all, one) => all + (one.transferSize ?? 0), 0)"
        )
        return paint / 1000, live / 1000, size


def measure(process: subprocess.Popen[bytes], port: int, folder: Path, devices: int) -> None:
    until_up(port, devices)
    begun, used = time.monotonic(), processor(process)
    size = len(fetched(port, "/metrics"))
    taken = time.monotonic() - begun
    print(
        f"one scrape: {size / 1e6:.1f} MB in {taken:.2f} s, {processor(process) - used:.2f} s CPU"
    )
    if chromium := shutil.which("chromium"):
        paint, live, loaded = asyncio.run(first_paint(port, chromium, folder / "profile"))
        print(f"first paint after {paint:.2f} s, values after {live:.2f} s, {loaded / 1000:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the plant, in each round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--alarms", action="store_true", help="every tag has an alarm")
    parser.add_argument("--lines", type=int, default=64)
    arguments = parser.parse_args()
    sizes = Sizes(arguments.lines, DEVICES, TAGS)
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        port, path = free_port(), Path(folder) / "plant.yaml"
        text = "\n".join(rows(sizes, free_endpoint(), alike=True, alarms=arguments.alarms))
        path.write_text(f'web: {{listen: "127.0.0.1:{port}"}}\n{text}\n')
        print(f"{sizes.all_tags} tags on {sizes.lines} lines", flush=True)
        compare(load(path), arguments.seconds, arguments.rounds)
        process = started(HERE, "run", path)
        try:
            measure(process, port, Path(folder), sizes.lines * sizes.devices)
        finally:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
