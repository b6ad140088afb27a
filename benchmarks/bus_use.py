"""The use of the wire on an overloaded line: `python -m benchmarks.bus_use`.

A line of the gateway talks over a pty to a wire at a real baud rate in another process. `busy` is
the time of characters on the wire, as a share of the time without turnarounds and silences.
`cycle` compares one round of all blocks with the forecast of `check`. A second run writes a
register three times a second; `write` is the longest time from the request to the
acknowledgement, and the bound that `check` prints.

`--silences` measures requests a second with the safe silence and with the learned one, in turn, in
four blocks of ten words. `--virtual`: on virtual time, so that no other program disturbs.

`--sets` measures a round of sets of 200 tags of one Vigor station at 19200 baud, against the sum of
its blocks: what is lost because neighbours must differ in shape.
"""

import argparse
import asyncio
import itertools
import json
import logging
import random
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import structlog

from benchmarks.words import words
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.engine.forecast import forecast
from gateway.errors import GatewayError
from gateway.line.line import Line
from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.port import open_simulator
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.modbus import ModbusStation
from gateway.stations.station import Station
from gateway.stations.vigor import VigorStation
from gateway.tags import Sample, Tag
from gateway.transport import SerialPath, SerialSettings, open_port
from tests.sim.plant import device as plant_device
from tests.sim.plant import make_tag, plant, running
from tests.sim.virtual import run_virtual

TURNAROUND = 0.005
BLOCKS, WORDS, FEW = 4, 64, 10
LEARNING = 60.0  # seconds at most
SETS = ("words, gaps of 0 to 20", "1, 2 or 4 floats", "bits of 1 to 3 words", "single words")


class Setting(NamedTuple):
    driver: Callable[[], AnyDriver]
    station: Callable[[], Station]
    format: str
    area: str

    @property
    def bits(self) -> int:
        return character_bits(self.format)


SETTINGS = {
    "vigor": Setting(lambda: Vigor(station=1), lambda: VigorStation(1), "7E1", "D"),
    "computer-link": Setting(
        lambda: ComputerLink(station=1), lambda: ComputerLinkStation(1), "7E1", "D"
    ),
    "modbus-rtu": Setting(
        lambda: ModbusRtu(station=1), lambda: ModbusStation(station=1), "8E1", "holding"
    ),
}


class Counting:
    """A sample sink that only counts."""

    def __init__(self) -> None:
        self.count = 0
        self.times: list[float] = []

    def samples(self, samples: Sequence[Sample]) -> None:
        self.count += len(samples)
        self.times.append(asyncio.get_running_loop().time())

    def online(self, device: Device, online: bool) -> None:
        pass


@dataclass(frozen=True)
class Result:
    busy: float
    cycle: float
    predicted: float
    exchanges: int
    blocks: int = BLOCKS
    write: float = 0.0
    bound: float = 0.0


def tags(area: str, size: int = WORDS) -> tuple[Tag, ...]:
    """Four blocks of so many words, with intervals ten times too short for any line."""
    # Too far apart to share a request.
    numbers = [number + (number // size) * 200 for number in range(BLOCKS * size)]
    return words(area, numbers, 0.01, writable=numbers[:1])


async def writing(line: Line, device: Device, tag: Tag, took: list[float]) -> None:
    """Writes three times a second, at times that are independent of the polls."""
    number = 0
    while True:
        await asyncio.sleep(0.29 + 0.13 * random.random())
        number += 1
        with suppress(GatewayError):
            took.append((await line.write(device, tag, tag.encode(number))).took)


def paced(name: str, baud: int, turnaround: float) -> "tuple[subprocess.Popen[str], str]":
    """Starts the wire. Returns its process, and the path of its pty."""
    child = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.paced_wire", name, str(baud), str(turnaround)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    return child, child.stdout.readline().strip()


async def rate(
    name: str, baud: int, turnaround: float, seconds: float, *, learn: bool, virtual: bool
) -> tuple[float, float]:
    """Returns the requests a second, and the silence before a poll."""
    setting = SETTINGS[name]
    driver, wire = setting.driver(), WireTiming(baud, setting.bits)
    settings = DeviceSettings(
        name="plc",
        driver=driver,
        timing=driver.timing if learn else replace(driver.timing, learn_silence=False),
        turnaround=turnaround,
        tags=tags(setting.area, FEW),
    )
    device = Device(settings, wire)
    child: subprocess.Popen[str] | None = None
    if virtual:
        stations = [setting.station()]
        opener = partial(open_simulator, stations, wire, turnaround=turnaround)
    else:
        child, path = paced(name, baud, turnaround)
        opener = partial(open_port, SerialPath(path), SerialSettings(baud, "8N1"))
    sink = Counting()
    task = asyncio.create_task(Line(Engine("bench", [device], wire), opener, sink).run())
    await asyncio.sleep(1.0)
    with suppress(TimeoutError):
        async with asyncio.timeout(LEARNING):
            while device.silence.shorter > device.silence.least:
                await asyncio.sleep(0.1)
    sink.times.clear()
    await asyncio.sleep(seconds)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    if child is not None:
        assert child.stdin is not None
        child.stdin.close()
        child.wait()
    gaps = sorted(after - before for before, after in itertools.pairwise(sink.times))
    usual = gaps if virtual else gaps[len(gaps) // 4 : len(gaps) * 3 // 4]
    return len(usual) / sum(usual), device.silence.shorter


async def measure(
    name: str,
    baud: int,
    seconds: float,
    *,
    writes: bool = False,
    turnaround: float = TURNAROUND,
    chosen: tuple[Tag, ...] | None = None,
) -> Result:
    """`chosen`: other tags than the four full blocks."""
    setting = SETTINGS[name]
    child, path = paced(name, baud, turnaround)
    assert child.stdin is not None
    assert child.stdout is not None
    driver, wire = setting.driver(), WireTiming(baud, setting.bits)
    settings = DeviceSettings(
        name="plc",
        driver=driver,
        timing=driver.timing,
        turnaround=turnaround,
        tags=chosen or tags(setting.area),
    )
    device = Device(settings, wire)
    # 8N1 on the pty whatever the format: a pty cannot do parity.
    serial = SerialSettings(baud, "8N1")
    line = Line(
        Engine("bench", [device], wire),
        lambda receiver: open_port(SerialPath(path), serial, receiver),
        Counting(),
    )
    tasks = [asyncio.create_task(line.run())]
    took: list[float] = []
    if writes:
        await asyncio.sleep(0.5)  # the line is open by then
        tasks.append(asyncio.create_task(writing(line, device, device.tags[0], took)))
    while not device.record.exchanges:
        await asyncio.sleep(0.01)
    await asyncio.sleep(seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    child.stdin.close()
    passed = json.loads(child.stdout.readline())
    child.wait()
    exchanges = passed["exchanges"]
    silences = (exchanges - 1) * wire.silence(driver.timing)
    free = passed["elapsed"] - passed["turnarounds"] - silences
    promised = forecast("bench", [device], wire)
    return Result(
        write=max(took, default=0.0),
        bound=promised.worst_write,
        busy=passed["characters"] * wire.character / free,
        cycle=passed["elapsed"] / exchanges * len(device.blocks),
        predicted=promised.cycle,
        exchanges=exchanges,
        blocks=len(device.blocks),
    )


def scattered(kind: str) -> list[Tag]:
    """Returns 200 tags in small blocks."""
    rng, found, at = random.Random(kind), list[Tag](), 0
    while len(found) < 200:
        match kind:
            case "words, gaps of 0 to 20":
                at += 1 + rng.choice([0, 0, 0, 1, 5, 20, 20])
                found.append(make_tag(f"D{at}", type="uint16", every=0.01))
            case "1, 2 or 4 floats":
                at += 30
                some = range(at, at + 2 * rng.choice([1, 2, 4]), 2)
                found += [make_tag(f"D{n}", type="float32", every=0.01) for n in some]
            case "bits of 1 to 3 words":
                at += 30
                places = [(at + n, bit) for n in range(rng.choice([1, 1, 2, 3])) for bit in (2, 7)]
                found += [make_tag(f"D{n}.{bit}", every=0.01) for n, bit in places]
            case "single words":
                at += 30
                found.append(make_tag(f"D{at}", type="uint16", every=0.01))
    return found[:200]


async def round_of(kind: str, seconds: float) -> tuple[int, float, float]:
    """Returns the blocks of the set, the seconds of a round, and those of its blocks alone."""
    plc = plant_device(scattered(kind), learn_silence=False)
    async with running(plant([plc])):
        await asyncio.sleep(30.0)
        before = plc.record.exchanges
        await asyncio.sleep(seconds)
        rounds = (plc.record.exchanges - before) / len(plc.blocks)
    return len(plc.blocks), seconds / rounds, sum(plc.seconds(one.cost) for one in plc.blocks)


def sets(seconds: float) -> None:
    for kind in SETS:
        blocks, took, least = run_virtual(round_of(kind, seconds))
        print(f"| {kind} | {blocks} | {took:.3f} s | {least:.3f} s | {took / least:.3f} |")


def silences(bauds: Sequence[int], seconds: float, *, virtual: bool) -> None:
    """Prints the requests a second with the safe and the learned silence, in turn."""
    print("protocol       baud turnaround    safe learned  ratio      silence")
    for name, setting in SETTINGS.items():
        if not setting.driver().timing.learn_silence:
            continue
        for baud in bauds:
            for turnaround in (0.005, 0.001):
                run = partial(rate, name, baud, turnaround, seconds, virtual=virtual)
                begin = run_virtual if virtual else asyncio.run
                safe, kept = begin(run(learn=False))
                learned, short = begin(run(learn=True))
                print(
                    f"{name:13} {baud:6} {turnaround * 1000:7.0f} ms {safe:7.1f} {learned:7.1f} "
                    f"{learned / safe:6.2f} "
                    f"{kept * 1000:4.1f} -> {short * 1000:.2f} ms",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--protocols", nargs="*", default=list(SETTINGS))
    parser.add_argument("--bauds", nargs="*", type=int, default=[9600, 19200, 38400, 115200])
    parser.add_argument("--silences", action="store_true", help="safe and learned silences")
    parser.add_argument("--virtual", action="store_true", help="the silences on virtual time")
    parser.add_argument("--sets", action="store_true", help="rounds of sets of 200 tags")
    arguments = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    if arguments.sets:
        sets(max(arguments.seconds, 30.0))
        return
    if arguments.silences:
        silences(arguments.bauds, arguments.seconds, virtual=arguments.virtual)
        return
    columns = "exchanges    busy     cycle  predicted             write"
    print(f"{'protocol':14} {'baud':>7} {columns}")
    for name in arguments.protocols:
        for baud in arguments.bauds:
            result = asyncio.run(measure(name, baud, arguments.seconds))
            written = asyncio.run(measure(name, baud, arguments.seconds, writes=True))
            print(
                f"{name:14} {baud:7} {result.exchanges:9} {result.busy:7.1%} "
                f"{result.cycle * 1000:6.1f} ms {result.predicted * 1000:6.1f} ms "
                f"({result.cycle / result.predicted - 1:+.1%})  "
                f"{written.write * 1000:5.1f} of {written.bound * 1000:5.1f} ms"
            )


if __name__ == "__main__":
    main()
