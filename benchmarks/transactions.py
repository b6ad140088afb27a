"""CPU per read of 64 words: `python -m benchmarks.transactions`.

Compares our whole line (engine, transaction, driver, decoding, mirror) with pymodbus's asyncio
client, npm's modbus-serial (where it is installed) and a libmodbus loop in C, against the same
slave (libmodbus, in another process) in one run.
Its registers keep their values; for the rows `changing` all of them change between two reads. No
foreign Vigor slave exists, so a simulated station in another process replies. Figures are
processor time of this process, or of that of the peer, per exchange. Compare ratios within one run.
"""

import argparse
import asyncio
import contextlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import structlog
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

from benchmarks.words import words
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.line.line import Line
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.tags import Sample, Tag
from gateway.tags.mirror import Mirror
from gateway.transport import Port, Receiver, SerialPath, SerialSettings, TcpAddress, open_port
from gateway.transport.loop import new_event_loop
from tests.zenoh_peer import free_port

INTEROP = Path(__file__).parent.parent / "tests" / "interop"
WORDS, FIRST = 64, 100
VIGOR_STATION = """
import asyncio, sys
from gateway.stations.vigor import VigorStation
from gateway.simulator.serve import serve_on_pty, serve_on_tcp
from gateway.planning.wire_timing import WireTiming

async def main():
    wire = WireTiming(115200, 10)
    stations = [VigorStation(1)]
    if sys.argv[1] == "pty":
        served = await serve_on_pty(stations, wire, turnaround=0, paced=False)
    else:
        served = await serve_on_tcp(stations, wire, "127.0.0.1", 0, turnaround=0, paced=False)
    print(served.address, flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


class Counting:
    """Updates a mirror as the gateway does; sets `done` after so many exchanges.

    `take`: takes the samples to publish, as the publisher does.
    """

    def __init__(self, tags: Sequence[Tag], exchanges: int, *, take: bool = False) -> None:
        self._take = take
        self._mirror = Mirror(tags, 0)
        self._left = exchanges
        self.done = asyncio.Event()
        self.cpu = 0.0

    def samples(self, samples: Sequence[Sample]) -> None:
        to_publish = self._mirror.update(samples)
        if self._take:
            list(to_publish)
        self._left -= 1
        if self._left == 0:
            self.cpu = time.process_time()
            self.done.set()

    def online(self, device: Device, online: bool) -> None:
        pass


def tags(area: str, each: int) -> tuple[Tag, ...]:
    """64 words as 64 tags, or as 2 tags at both ends (`each` = 1 or 63)."""
    return words(area, range(FIRST, FIRST + WORDS, each), 1e-6, kind="uint16")


async def ours(
    driver: AnyDriver,
    area: str,
    each: int,
    where: Callable[[Receiver], Awaitable[Port]],
    count: int,
    *,
    take: bool = False,
) -> float:
    """Seconds of processor time per exchange, without silences: they would only add sleep."""
    timing = replace(driver.timing, silence=0.0, silence_chars=0.0)
    wire = WireTiming(NETWORK_BAUD, 10)
    chosen = tags(area, each)
    settings = DeviceSettings(name="plc", driver=driver, timing=timing, turnaround=1.0, tags=chosen)
    device = Device(settings, wire)
    assert len(device.blocks) == 1, device.blocks
    sink = Counting(chosen, count, take=take)
    line = Line(Engine("bench", [device], wire), where, sink)
    begun = time.process_time()
    task = asyncio.create_task(line.run())
    await sink.done.wait()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return (sink.cpu - begun) / count


async def pymodbus(
    make: Callable[[], AsyncModbusTcpClient | AsyncModbusSerialClient], count: int
) -> float:
    client = make()
    await client.connect()
    begun = time.process_time()
    for _ in range(count):
        reply = await client.read_holding_registers(FIRST, count=WORDS, device_id=1)
        assert len(reply.registers) == WORDS
    spent = time.process_time() - begun
    client.close()
    return spent / count


def libmodbus(master: Path, mode: str, where: str, count: int) -> float:
    """The C loop prints microseconds per read: wall clock and processor time."""
    command = [str(master), mode, where, "1", str(count)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return float(output.split()[1]) / 1e6


def modbus_serial(mode: str, where: str, count: int) -> float:
    """Returns seconds of processor time, after 5,000 reads in which Node compiles."""
    script = Path(__file__).with_name("modbus_serial_reads.js")
    command = ["node", str(script), mode, where, str(count)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return float(output.split()[1]) / 1e6


def has_modbus_serial() -> bool:
    return shutil.which("node") is not None and (INTEROP / "node_modules/modbus-serial").is_dir()


@contextlib.contextmanager
def process(*command: str | Path) -> Iterator[str]:
    """A peer in another process; yields the first line that it prints."""
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    try:
        yield child.stdout.readline().strip()
    finally:
        child.terminate()
        child.wait()
        child.stdout.close()


def compiled(folder: Path, name: str) -> Path | None:
    flags = ["-I/usr/include/modbus", "-lmodbus"]
    if not Path("/usr/include/modbus/modbus.h").exists() or shutil.which("cc") is None:
        return None
    program = folder / name
    subprocess.run(["cc", "-O2", INTEROP / f"{name}.c", "-o", program, *flags], check=True)
    return program


@contextlib.contextmanager
def pty_pair(folder: Path, name: str) -> Iterator[tuple[str, str]]:
    ends = [str(folder / f"{name}{end}") for end in (1, 2)]
    child = subprocess.Popen(["socat", *(f"pty,raw,echo=0,link={end}" for end in ends)])
    try:
        while not all(Path(end).exists() for end in ends):
            time.sleep(0.01)
        yield ends[0], ends[1]
    finally:
        child.terminate()
        child.wait()


def run(coroutine: Coroutine[Any, Any, float]) -> float:
    """On asyncio's own event loop."""
    return asyncio.run(coroutine)


def run_fast(coroutine: Coroutine[Any, Any, float]) -> float:
    """On uvloop, as the service does."""
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        return runner.run(coroutine)


def tcp_opener(port: int) -> Callable[[Receiver], Awaitable[Port]]:
    return lambda receiver: open_port(TcpAddress("127.0.0.1", port), SerialSettings(), receiver)


def serial_opener(path: str) -> Callable[[Receiver], Awaitable[Port]]:
    return lambda receiver: open_port(SerialPath(path), SerialSettings(115200, "8N1"), receiver)


Runs = dict[str, Callable[[int], float]]


def repeated(runs: Runs, count: int, rounds: int) -> dict[str, float]:
    """The least of a few rounds, as other programs only add time. Each round runs all in turn."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            found[name].append(run(count) * 1e6)
    return {name: min(values) for name, values in found.items()}


def beside(
    driver: AnyDriver,
    area: str,
    opener: Callable[[Receiver], Awaitable[Port]],
    client: Callable[[], AsyncModbusTcpClient | AsyncModbusSerialClient] | None = None,
    in_c: Callable[[int], float] | None = None,
    in_node: Callable[[int], float] | None = None,
    changing: Callable[[Receiver], Awaitable[Port]] | None = None,
) -> Runs:
    """Ours and the other masters of that slave; once more on uvloop where it is installed.

    `changing` opens a port to a slave whose registers all change between two reads.
    """
    loops = {"": run}
    if find_spec("uvloop") is not None:
        loops[", uvloop"] = run_fast
    runs: Runs = {}
    for suffix, on in loops.items():

        def read(
            step: int,
            opener: Callable[[Receiver], Awaitable[Port]],
            on: Callable[[Coroutine[Any, Any, float]], float] = on,
            *,
            take: bool = False,
        ) -> Callable[[int], float]:
            return lambda count: on(ours(driver, area, step, opener, count, take=take))

        for tags, step in ((2, 63), (64, 1)):
            runs[f"ours, {tags} tags{suffix}"] = read(step, opener)
            if changing is not None:
                runs[f"ours, {tags} changing tags{suffix}"] = read(step, changing)
        if changing is not None:
            runs[f"ours, 64 made samples{suffix}"] = read(1, changing, take=True)
        if client is not None:
            runs["pymodbus client" + suffix] = partial(_of_pymodbus, on, client)
    if in_c is not None:
        runs["libmodbus in C"] = in_c
    if in_node is not None and has_modbus_serial():
        runs["npm's modbus-serial"] = in_node
    return runs


def _of_pymodbus(
    on: Callable[[Coroutine[Any, Any, float]], float],
    client: Callable[[], AsyncModbusTcpClient | AsyncModbusSerialClient],
    count: int,
) -> float:
    return on(pymodbus(client, count))


def modbus_tcp(folder: Path, count: int, rounds: int) -> dict[str, float] | None:
    slave, master = compiled(folder, "modbus_slave"), compiled(folder, "modbus_master")
    if slave is None or master is None:
        return None
    port, other = free_port(), free_port()
    with process(slave, "tcp", str(port)), process(slave, "tcp", str(other), "changing"):
        runs = beside(
            ModbusTcp(station=1),
            "holding",
            tcp_opener(port),
            lambda: AsyncModbusTcpClient("127.0.0.1", port=port),
            lambda n: libmodbus(master, "tcp", str(port), n),
            lambda n: modbus_serial("tcp", str(port), n),
            tcp_opener(other),
        )
        return repeated(runs, count, rounds)


def modbus_rtu(folder: Path, count: int, rounds: int) -> dict[str, float] | None:
    slave, master = compiled(folder, "modbus_slave"), compiled(folder, "modbus_master")
    if slave is None or master is None or shutil.which("socat") is None:
        return None
    with (
        pty_pair(folder, "a") as (near, far),
        pty_pair(folder, "c") as (other, end),
        process(slave, "rtu", far, "1"),
        process(slave, "rtu", end, "1", "changing"),
    ):
        runs = beside(
            ModbusRtu(station=1),
            "holding",
            serial_opener(near),
            lambda: AsyncModbusSerialClient(near, baudrate=115200),
            lambda n: libmodbus(master, "rtu", near, n),
            lambda n: modbus_serial("rtu", near, n),
            serial_opener(other),
        )
        return repeated(runs, count, rounds)


def vigor(count: int, rounds: int, way: str) -> dict[str, float]:
    with process(sys.executable, "-c", VIGOR_STATION, way) as where:
        opener = serial_opener(where)
        if way == "tcp":
            opener = tcp_opener(int(where.rpartition(":")[2]))
        return repeated(beside(Vigor(station=1), "D", opener), count, rounds)


def on_one_core() -> None:
    """Runs this process and its peers on one core.

    To wake another core often costs more than the read itself on a virtual machine.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    on_one_core()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    count, rounds = arguments.count, arguments.rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tables = {
            "Modbus TCP": modbus_tcp(folder, count, rounds),
            "Modbus RTU on a pty": modbus_rtu(folder, count, rounds),
            "Vigor over TCP": vigor(count, rounds, "tcp"),
            "Vigor on a pty": vigor(count, rounds, "pty"),
        }
    for title, figures in tables.items():
        print(f"\n{title}: microseconds of CPU per read of {WORDS} words")
        if figures is None:
            print("  not run: needs libmodbus, a C compiler and socat")
            continue
        for contestant, spent in figures.items():
            ratios = "".join(
                f"  {spent / figures[other]:5.2f} x {other}"
                for other in ("pymodbus client", "libmodbus in C")
                if other in figures and other != contestant
            )
            print(f"  {contestant:23} {spent:7.1f}{ratios}")


if __name__ == "__main__":
    main()
