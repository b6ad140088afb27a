"""The pictures of the page: `make pictures`, or `python -m benchmarks.pictures [--docs]`.

Gateways with simulated PLCs run: one that is well, one with a fault, one with many, one with 5,000
tags. Chromium looks at each view of their pages, on a phone, a laptop and a wall display, in light
and dark, in English or with `--language` in another. All pictures are in `build/pictures`; `--docs`
copies those of the pages to `docs/`.
"""

import argparse
import asyncio
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from benchmarks.start import Sizes, rows
from gateway.contract.languages import LANGUAGES, Language
from gateway.parts.web.fleet.api import ASK_EVERY
from tests.cli.bench_page import BenchPage, benched, shown
from tests.cli.test_fleet import REPORT
from tests.e2e.processes import ROOT, free_port, plc_gateway, started
from tests.web.browser import Tab, browser
from tests.web.serving import TOKEN, serving
from tests.zenoh_peer import free_endpoint

SIZES = {"phone": (390, 844), "laptop": (1366, 768), "wall": (1920, 1080)}
TREND = "trend?span=300&tags=oven/temperature,mixer/level"
SCHEMES = ("light", "dark")
VIEWS = {
    **{name: name for name in ("overview", "tags", "alarms", "lines")},
    "trend": TREND,
    "search": "tags?find=oven",
}
PLANTS = ("well", "fault", "many", "large")
ACKNOWLEDGED = {"fault": ("drive-3",), "many": ("mixer/speed", "line:yard", "boiler/flow")}
LARGE = Sizes(10, 5, 100)
DOCS = {
    "bench.png": "bench-laptop-light.png",
    "page.png": "fault-overview-laptop-light.png",
    "page-phone.png": "many-overview-phone-dark.png",
    "page-trend.png": "well-trend-laptop-dark.png",
    "page-zh-tw.png": "fault-overview-laptop-light-zh-TW.png",
}
HALL_1 = """
mixer:
  protocol: vigor
  station: 1
  tags:
    speed: {address: D100, scale: 0.1, unit: rpm, description: Stirrer, alarm: {high: 95}}
    level: {address: D10, type: float32, unit: "%", decimals: 1, description: Level of the mixer,
      alarm: {high: 92, high_high: 97, text: Mixer too full}}
    batches: {address: C200, description: Batches since the last service}
    mode: {address: D20, enum: {0: "off", 1: auto, 2: manual}, write: true}
    door: {address: M12, description: Guard door open}
oven:
  protocol: computer-link
  station: 5
  tags:
    temperature: {address: D0100, scale: 0.1, unit: °C, description: Temperature of the chamber,
      alarm: {high: 91, low: 5}}
    setpoint: {address: D0101, unit: °C, description: Wanted temperature,
      write: {min: 20, max: 250, verify: true}}
    heating: {address: Y0000, description: Heating is on}
"""
BOILER = """
boiler:
  protocol: modbus-rtu
  station: 9
  tags:
    power: {address: "input:100", unit: kW, description: Burner}
    flow: {address: "input:101", scale: 0.1, unit: m³/h, description: Feed pump}
    pressure: {address: "input:102", scale: 0.01, unit: bar, alarm: {high: 95}}
"""
DRIVES = """
drive-{n}:
  protocol: modbus-rtu
  station: {n}
  tags:
    current: {{address: "holding:5", scale: 0.1, unit: A, description: Motor current}}
    setpoint: {{address: "holding:6", unit: rpm, write: {{min: 0, max: 5000}}}}
"""


def drives(*stations: int) -> Any:
    return {name: one for n in stations for name, one in yaml.safe_load(DRIVES.format(n=n)).items()}


def plant(ports: "Ports", *, fault: bool = False, many: bool = False) -> dict[str, Any]:
    """Returns the lines of a plant."""
    hall = yaml.safe_load(HALL_1)
    lines = {
        "hall-1": {"port": "simulator", "baudrate": 19200, "devices": hall},
        "boiler-room": {"port": "simulator", "baudrate": 9600, "devices": yaml.safe_load(BOILER)},
        "hall-2": {"port": "simulator", "baudrate": 19200, "devices": drives(3)},
    }
    if fault or many:
        lines["hall-2"]["port"] = ports.silent
        hall["oven"]["tags"]["temperature"]["alarm"] = {"high": 5, "text": "Oven too hot"}
    if many:
        for device in hall.values():
            for tag in device["tags"].values():
                if tag.get("unit") and not tag.get("write"):
                    tag["alarm"] = {"high": 5, "high_high": 70}
        pump = drives(0)["drive-0"]
        pump["tags"]["current"]["alarm"] = {"high": 1, "text": "Pump overloaded"}
        lines["boiler-room"]["devices"] |= {
            f"pump-{number}": {**pump, "station": 20 + number} for number in range(6)
        }
        others = {"hall-3": ports.noise, "hall-4": ports.echo, "yard": "/dev/ttyUSB7"}
        for at, (name, port) in enumerate(others.items()):
            stations = range(30 + 5 * at, 33 + 5 * at)
            lines[name] = {"port": port, "baudrate": 9600, "devices": drives(*stations)}
    return lines


class Ports:
    """TCP ports of lines with a fault."""

    def __init__(self) -> None:
        self.silent, self.noise, self.echo = (f"tcp://127.0.0.1:{free_port()}" for _ in range(3))

    async def serve(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        for port, mask in ((self.silent, None), (self.noise, 0x5A), (self.echo, 0)):
            number = int(port.rpartition(":")[2])
            server = await loop.create_server(partial(Peer, mask), "127.0.0.1", number)
            await stack.enter_async_context(server)


class Peer(asyncio.Protocol):
    """Returns what it receives, with some bits changed; without a mask it is silent."""

    def __init__(self, mask: int | None) -> None:
        self._mask = mask

    def connection_made(self, transport: Any) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if self._mask is not None:
            self._transport.write(bytes(byte ^ self._mask for byte in data))


def files(folder: Path, ports: Ports, language: Language) -> Iterator[tuple[str, Path, int]]:
    """Writes the file of each situation; yields its name, its file, and the port of its page."""
    (folder / "tokens.txt").write_text(f"alice:{TOKEN}\n")
    (folder / "tokens.txt").chmod(0o600)
    for name, how in (("well", {}), ("fault", {"fault": True}), ("many", {"many": True})):
        path, port = folder / f"{name}.yaml", free_port()
        config = {
            "gateway": {"name": "hall"},
            "zenoh": {"listen": [free_endpoint()]},
            "web": {
                "listen": f"127.0.0.1:{port}",
                "tokens_file": "tokens.txt",
                "language": language,
            },
            "history": {"path": f"{name}.db"},
            "alarms": {"path": f"{name}.json", "devices": True},
            "defaults": {"every": "500ms", "history": True},
            "lines": plant(ports, **how),
        }
        path.write_text(yaml.safe_dump(config, allow_unicode=True, sort_keys=False))
        yield name, path, port
    path, port = folder / "large.yaml", free_port()
    text = "\n".join(rows(LARGE, free_endpoint(), alike=True, alarms=True))
    path.write_text(f'web: {{listen: "127.0.0.1:{port}"}}\n{text}\n')
    yield "large", path, port


async def taken(tab: Tab, name: str, port: int, arguments: argparse.Namespace) -> None:
    end = "" if arguments.language == "en" else f"-{arguments.language}"
    for view, address in VIEWS.items():
        if name == "large" and view in ("trend", "search"):
            address = {"trend": "trend?span=300&tags=d0-0/t0", "search": "tags?find=t42"}[view]
        for size in arguments.sizes:
            width, height = SIZES[size]
            for scheme in arguments.schemes:
                await tab.open("about:blank")  # the same address would not be loaded again
                await tab.look(width, height, dark=scheme == "dark")
                await tab.open(f"http://127.0.0.1:{port}/#{address}")
                await tab.until(READY.get(view, READY["overview"]))
                wide = await tab.value("document.documentElement.scrollWidth")
                assert wide <= width, f"{name} {view} is {wide} wide on a {size}"
                await tab.screenshot(arguments.into / f"{name}-{view}-{size}-{scheme}{end}.png")


LIVE = 'document.body?.className === ""'
READY = {
    "overview": f'{LIVE} && document.querySelector("#lines-short li")'
    ' && document.querySelector(".tile") && !document.querySelector(".tile.old")'
    ' && [...document.querySelectorAll(".tile:not(.is-bad) .trail")]'
    '.every((one) => (one.getAttribute("d").match(/H/g) ?? []).length > 2)',
    "tags": f'{LIVE} && document.querySelectorAll("#space .value").length',
    "lines": f'{LIVE} && document.querySelectorAll("#lines-list li").length',
    "alarms": f'{LIVE} && document.querySelectorAll("#alarms-list li").length',
    "trend": 'document.querySelector("#chart canvas") && '
    '/\\d/.test(document.getElementById("trend-text").textContent)',
}
READY["search"] = READY["tags"]


async def look(situations: list[tuple[str, Path, int]], arguments: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:  # it ends late
        async with browser(arguments.chromium, Path(profile)) as tab:
            for name, _, port in situations:
                await taken(tab, name, port, arguments)
            assert tab.errors == []


async def look_at_bench(arguments: argparse.Namespace) -> None:
    """The bench with a change that is not kept yet."""
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        addresses, _ = await stack.enter_async_context(benched(folder / "plant.yaml"))
        tab = await stack.enter_async_context(browser(arguments.chromium, folder / "profile"))
        page = BenchPage(tab)
        for size in arguments.sizes:
            for scheme in arguments.schemes:
                await tab.look(*SIZES[size], dark=scheme == "dark")
                if not page.clicks:
                    await page.named(await addresses.get())
                    await page.click("#apply", f"{shown('#good')} === '20 of 20 values are good'")
                    await tab.value("document.querySelectorAll('.name')[24].value = 'recipe'")
                    await page.click("#add-tags", f"{shown('#size')} === '21 tags on 1 line'")
                await tab.value("document.getElementById('main').scrollTo(0, 0)")
                await tab.screenshot(arguments.into / f"bench-{size}-{scheme}.png")
        assert tab.errors == []


def many_gateways(number: int) -> Iterator[tuple[str, bytes, float]]:
    """Yields the reports of gateways of a works, some of them with a fault."""
    now = time.time()
    since = time.strftime("%Y-%m-%dT%H:%M:%S.000000Z", time.gmtime(now))
    for at in range(number):
        found = {**REPORT, "name": f"g{at}", "version": "1.0.0", "time": since, "tags": 300}
        found["load"] = (at * 37 % 90) / 100
        if at % 10 == 4:
            found["group"], found["stand"] = "hall", ("active", "standby")[at // 10 % 2]
        if at % 23 == 7:
            found["faults"], found["devices"] = {"device-silent": 2}, {"up": 10, "silent": 2}
            found["fault"] = "mixer is silent: no byte came back: check power, wiring and station"
        if at % 41 == 3:
            found["faults"], found["fault"] = {"history": 1}, "the disk of history is full"
        if at % 31 == 5:
            found["version"] = "0.9.2"
        payload = json.dumps(found).encode()
        yield f"works/hall-{at % 20}/@gateway/g{at}/report", payload, now


async def look_at_fleet(arguments: argparse.Namespace) -> None:
    """Few gateways, and many, some of which are silent."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        async with browser(arguments.chromium, Path(profile)) as tab:
            for number, lost in ((24, 2), (1000, 15)):
                async with serving(fleet=True) as client:
                    client.north.fleet = partial(many_gateways, number)
                    await client.ask("/api/fleet")
                    client.north.fleet = partial(many_gateways, number - lost)
                    await asyncio.sleep(ASK_EVERY)
                    for size in arguments.sizes:
                        for scheme in arguments.schemes:
                            await tab.open("about:blank")
                            await tab.look(*SIZES[size], dark=scheme == "dark")
                            await tab.open(f"http://127.0.0.1:{client.port}/#fleet")
                            await tab.until("document.querySelectorAll('#fleet-list li').length")
                            wide = await tab.value("document.documentElement.scrollWidth")
                            assert wide <= SIZES[size][0], f"fleet is {wide} wide on a {size}"
                            name = f"fleet-{number}-{size}-{scheme}.png"
                            await tab.screenshot(arguments.into / name)
            assert tab.errors == []


async def run(arguments: argparse.Namespace) -> None:
    arguments.into.mkdir(parents=True, exist_ok=True)
    if arguments.language == "en":
        await look_at_bench(arguments)
    await look_at_fleet(arguments)
    ports = Ports()
    async with AsyncExitStack() as stack:
        await ports.serve(stack)
        with tempfile.TemporaryDirectory() as folder, ExitStack() as programs:
            situations = list(files(Path(folder), ports, arguments.language))
            situations = [one for one in situations if one[0] in arguments.plants]
            for _, path, _ in situations:
                programs.enter_context(started(path))
            await asyncio.sleep(arguments.after)
            for name, path, _ in situations:
                await asyncio.to_thread(acknowledge, path, ACKNOWLEDGED.get(name, ()))
            await look(situations, arguments)


def acknowledge(path: Path, alarms: Sequence[str]) -> None:
    """Acknowledges some alarms, so that the pictures have each state."""
    for alarm in alarms:
        plc_gateway("alarms", path, "--ack", alarm, "--by", "Ana")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=ROOT / "build" / "pictures")
    parser.add_argument("--docs", action="store_true", help="copy some to docs/")
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--after", type=float, default=75.0, help="seconds that the gateways run")
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=PLANTS)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, default=SCHEMES)
    parser.add_argument("--language", choices=LANGUAGES, default="en")
    arguments = parser.parse_args()
    os.nice(5)
    asyncio.run(run(arguments))
    if arguments.docs:
        for name, picture in DOCS.items():
            if (arguments.into / picture).exists():
                shutil.copy(arguments.into / picture, ROOT / "docs" / name)


if __name__ == "__main__":
    main()
