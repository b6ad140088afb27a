"""This gateway beside its peers, in the tables of docs/peers.md: `python -m benchmarks.peers`.

The figures of other gateways in the first tables were measured before, on loopback, or follow from
their rules with the cost model of `peers_requests`. All others are measured by this run: this
gateway, pymodbus, libmodbus (C) and npm's modbus-serial. Name the tables to print: `requests`,
`mute`, `writes`, `processor`.
"""

import argparse
import asyncio
import logging
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import structlog
from pymodbus import FramerType, ModbusException
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

from benchmarks import bus_use, peers_requests, transactions
from benchmarks.words import words
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.errors import GatewayError
from gateway.line.line import Line
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming, character_bits
from gateway.protocols.modbus import ModbusTcp
from gateway.tags import Quality, Sample
from gateway.transport import SerialSettings, TcpAddress, open_port

# -- requests and seconds of wire in a cycle ---------------------------------------------------

# The rule by which each program makes requests, and where it is set.
RULES = [
    ("ThingsBoard gateway", None, "one request per tag"),
    ("mqmgateway", None, "one per register; `poll_groups` are written by hand"),
    ("Neuron", 0, "only registers in a row"),
    ("Telegraf, `none`, `shrink` or `rearrange`", 0, "only registers in a row"),
    ("Telegraf, `max_insert` with 1", 1, "a gap of one register"),
    ("Telegraf, `max_insert` with 50, its default", 50, "a fixed gap"),
]
RATES = (9600, 115200)


async def requests(seconds: float) -> None:
    print("| program | requests | s of wire at 9600 | at 115200 | rule |\n|---|---|---|---|---|")
    wires = [WireTiming(baud, character_bits("8E1")) for baud in RATES]

    def cells(plans: Sequence[Sequence[int]]) -> str:
        return " | ".join(
            f"{sum(peers_requests.seconds(wire, size) for size in sizes):.2f}"
            for wire, sizes in zip(wires, plans, strict=True)
        )

    for name, gap, rule in RULES:
        sizes = [1] * 200 if gap is None else peers_requests.fixed_gap(gap)
        print(f"| {name} | {len(sizes)} | {cells([sizes] * 2)} | {rule} |")
    ours = [peers_requests.ours(wire) for wire in wires]
    print(f"| this gateway | {' and '.join(sorted({str(len(o)) for o in ours}))} | {cells(ours)} | "
          "the least time, by speed and turnaround |")  # fmt: skip
    chosen = words("holding", peers_requests.addresses(), 0.01, kind="uint16")
    measured = []
    for baud in RATES:
        found = await bus_use.measure(
            "modbus-rtu", baud, seconds * 0.4, turnaround=peers_requests.TURNAROUND, chosen=chosen
        )
        measured.append(found)
    print(f"| this gateway, measured | {' and '.join(sorted({str(m.blocks) for m in measured}))} | "
          f"{' | '.join(f'{m.cycle:.2f}' for m in measured)} | on a paced pty |")  # fmt: skip


# -- a mute unit -------------------------------------------------------------------------------

HEALTHY, MUTE = 1, 2  # unit numbers behind one TCP connection
TEN = range(0, 200, 20)  # scattered: too far apart for one request
SERVER = """
import asyncio
from gateway.planning.wire_timing import WireTiming
from gateway.simulator.serve import serve_on_tcp
from gateway.stations.modbus import ModbusStation

async def main():
    units = [ModbusStation(station=1, framing="tcp"), ModbusStation(station=2, framing="tcp")]
    units[1].mute = True
    wire = WireTiming(115200, 10)
    served = await serve_on_tcp(units, wire, "127.0.0.1", 0, turnaround=0, paced=False)
    print(served.address.rpartition(":")[2], flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


class Sweeps(NamedTuple):
    """Sweeps of the healthy unit a second; the longest write to it, in seconds."""

    rate: float
    write: float


class Counting:
    """Counts good samples of the last tag of the healthy device: no write expedites it."""

    def __init__(self) -> None:
        self.sweeps = 0

    def samples(self, samples: Sequence[Sample]) -> None:
        for tag, _, quality, *_ in samples:
            self.sweeps += (
                tag.device == "healthy" and tag.name == "t180" and quality is Quality.GOOD
            )

    def online(self, device: Device, online: bool) -> None:
        pass


async def ours_beside_mute(port: int, timeout: float, seconds: float) -> Sweeps:
    wire = WireTiming(NETWORK_BAUD, 10)
    devices = []
    for name, unit in (("healthy", HEALTHY), ("mute", MUTE)):
        driver = ModbusTcp(station=unit)
        tags = words("holding", TEN, 1.0, kind="uint16", writable=[0])
        settings = DeviceSettings(
            name=name,
            driver=driver,
            timing=replace(driver.timing, reply_timeout=timeout),
            turnaround=0.005,
            tags=tuple(replace(tag, device=name) for tag in tags),
        )
        devices.append(Device(settings, wire))
    sink = Counting()
    where = TcpAddress("127.0.0.1", port)
    line = Line(
        Engine("bench", devices, wire),
        lambda receiver: open_port(where, SerialSettings(), receiver),
        sink,
    )
    task = asyncio.create_task(line.run())
    try:
        await asyncio.sleep(seconds / 2)  # until the mute unit is known
        took, begun, before = list[float](), time.monotonic(), sink.sweeps
        healthy = devices[0]
        while time.monotonic() - begun < seconds:
            asked = time.monotonic()
            with suppress(GatewayError):
                await line.write(healthy, healthy.tags[0], healthy.tags[0].encode(len(took)))
                took.append(time.monotonic() - asked)
            await asyncio.sleep(0.3 + 0.2 * random.random())
        return Sweeps(
            (sink.sweeps - before) / (time.monotonic() - begun), max(took, default=seconds)
        )
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def pymodbus_beside_mute(port: int, timeout: float, retries: int, seconds: float) -> Sweeps:
    """A plain program: one client, both units in turn, once a second; another task writes."""
    client = AsyncModbusTcpClient("127.0.0.1", port=port, timeout=timeout, retries=retries)
    await client.connect()
    sweeps, took = 0, list[float]()

    async def poll() -> None:
        nonlocal sweeps
        due = time.monotonic()
        while True:
            for unit in (HEALTHY, MUTE):
                for address in TEN:
                    with suppress(ModbusException):
                        await client.read_holding_registers(address, count=1, device_id=unit)
                sweeps += unit == HEALTHY
                if not client.connected:
                    await client.connect()
            due = max(due + 1.0, time.monotonic())
            await asyncio.sleep(due - time.monotonic())

    async def write() -> None:
        while True:
            await asyncio.sleep(0.3 + 0.2 * random.random())
            asked = time.monotonic()
            with suppress(ModbusException):
                await client.write_register(0, len(took), device_id=HEALTHY)
                took.append(time.monotonic() - asked)

    tasks = [asyncio.create_task(poll()), asyncio.create_task(write())]
    begun = time.monotonic()
    await asyncio.sleep(seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    client.close()
    return Sweeps(sweeps / (time.monotonic() - begun), max(took, default=seconds))


async def mute(seconds: float) -> None:
    print("| program | time-out | sweeps/s of the healthy unit | longest write to it | |")
    print("|---|---|---|---|---|")
    print("| Neuron | 1 s | 0.10 | 6.9 s | known |")
    print("| mqmgateway | 0.5 s | 0.034 | | known |")
    print("| ThingsBoard gateway, TCP | | not slower | | known |")
    with transactions.process(sys.executable, "-c", SERVER) as text:
        port = int(text)
        for timeout, retries in ((1.0, 0), (1.0, 3)):
            found = await pymodbus_beside_mute(port, timeout, retries, 4 * seconds)
            print(f"| a loop over pymodbus, {retries} retries | {timeout:g} s | {found.rate:.3f} | "
                  f"{found.write:.3f} s | measured |")  # fmt: skip
        for timeout in (1.0, 0.5):
            found = await ours_beside_mute(port, timeout, seconds)
            print(f"| this gateway | {timeout:g} s | {found.rate:.3f} | {found.write:.3f} s | "
                  "measured |")  # fmt: skip


# -- writes on a busy line ---------------------------------------------------------------------


@contextmanager
def paced(baud: int) -> Iterator[str]:
    """Yields a pty with a Modbus slave behind a wire of this speed."""
    command = [sys.executable, "-m", "benchmarks.paced_wire", "modbus-rtu", str(baud)]
    child = subprocess.Popen(
        [*command, str(bus_use.TURNAROUND)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        yield child.stdout.readline().strip()
    finally:
        child.stdin.close()
        child.wait()


async def pymodbus_writes(baud: int, seconds: float, *, at_once: bool) -> float:
    """Returns the longest write beside reads of the blocks of `bus_use`, one after another or all
    `at_once`, through one client."""
    with paced(baud) as path:
        client = AsyncModbusSerialClient(path, framer=FramerType.RTU, baudrate=baud, timeout=2)
        await client.connect()
        took = list[float]()

        async def read(block: int) -> None:
            address = block * (bus_use.WORDS + 200)
            await client.read_holding_registers(address, count=bus_use.WORDS, device_id=1)

        async def poll() -> None:
            while True:
                if at_once:
                    await asyncio.gather(*map(read, range(bus_use.BLOCKS)))
                else:
                    for block in range(bus_use.BLOCKS):
                        await read(block)

        async def write() -> None:
            while True:
                await asyncio.sleep(0.29 + 0.13 * random.random())
                asked = time.monotonic()
                await client.write_register(0, len(took), device_id=1)
                took.append(time.monotonic() - asked)

        tasks = [asyncio.create_task(poll()), asyncio.create_task(write())]
        await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        client.close()
        return max(took, default=seconds)


async def writes(seconds: float) -> None:
    print("| program | longest write at 9600 | at 115200 |\n|---|---|---|")
    found = [await bus_use.measure("modbus-rtu", baud, seconds, writes=True) for baud in RATES]
    cells = [f"{one.write * 1e3:.0f} ms ({one.bound * 1e3:.0f})" for one in found]
    print(f"| this gateway (the limit that `check` prints) | {' | '.join(cells)} |")
    for what, at_once in (("one read after another", False), ("reads of a cycle at once", True)):
        took = [await pymodbus_writes(baud, seconds, at_once=at_once) for baud in RATES]
        print(f"| pymodbus, {what} | {' | '.join(f'{one * 1e3:.0f} ms' for one in took)} |")


# -- processor time of a read ------------------------------------------------------------------


def processor(options: argparse.Namespace) -> None:
    transactions.on_one_core()  # for this process and its children, from here on: the last table
    count, rounds = options.count, options.rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ways = {
            "Modbus TCP": transactions.modbus_tcp(folder, count, rounds),
            "RTU on a pty": transactions.modbus_rtu(folder, count, rounds),
        }
    for title, figures in ways.items():
        if figures is None:
            print(f"{title}: not run: needs libmodbus, a C compiler and socat (.ci/install-peers)")
            continue
        print(f"\n| {title} | us | x pymodbus | x libmodbus | x modbus-serial |")
        print("|---|---|---|---|---|")
        for program, spent in figures.items():
            ratios = " | ".join(
                f"{spent / figures[other]:.2f}" if other in figures else "-"
                for other in ("pymodbus client", "libmodbus in C", "npm's modbus-serial")
            )
            print(f"| {program} | {spent:.1f} | {ratios} |")


TABLES: dict[str, Callable[[argparse.Namespace], None]] = {
    "requests": lambda options: asyncio.run(requests(options.seconds)),
    "mute": lambda options: asyncio.run(mute(options.seconds)),
    "writes": lambda options: asyncio.run(writes(options.seconds)),
    "processor": processor,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", metavar="TABLE", default=list(TABLES))
    parser.add_argument("--seconds", type=float, default=20.0, help="of most rows")
    parser.add_argument("--count", type=int, default=2000, help="reads, for processor time")
    parser.add_argument("--rounds", type=int, default=6, help="for processor time")
    options = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    for table in options.tables:
        print(f"\n## {table}\n", flush=True)
        TABLES[table](options)


if __name__ == "__main__":
    main()
