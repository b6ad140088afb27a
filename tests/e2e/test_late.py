"""Late replies in real time on a pty; other tests use virtual time."""

import asyncio
import random
from dataclasses import dataclass
from typing import Any

from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Timing
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.simulator.serve import serve_on_pty
from gateway.stations.modbus import ModbusStation
from gateway.transport import Receiver, SerialPath, SerialSettings, open_port
from tests.sim.bench import Bench, Unruly
from tests.sim.plant import Plant, clock_word, made_device, make_tag, running
from tests.sim.witness import Witness

WIRE = WireTiming(115200, 10)
TIMEOUT, SECONDS = 0.05, 6.0


@dataclass
class PtyBench(Bench):
    """The port is a pty with the stations behind it."""

    path: str = ""

    async def open(self, stations: Any, wire: WireTiming, ear: Receiver) -> "PtyBench":
        self.ear = ear
        self.inner = await open_port(SerialPath(self.path), SerialSettings(115200, "8N1"), self)
        return self


async def test_late_replies_give_no_wrong_value_in_real_time() -> None:
    """Both at once, on two lines, because they mostly wait."""
    await asyncio.gather(_no_wrong_value(ModbusRtu), _no_wrong_value(ModbusAscii))


async def _no_wrong_value(kind: type[ModbusRtu | ModbusAscii]) -> None:
    """A quarter of the replies are 50 to 150 ms late; blocks have equal and different sizes."""
    driver = kind(station=1)
    tags = [
        make_tag(f"holding:{number}", driver, type="uint16", every=0.02)
        for block, size in enumerate((3, 3, 5))
        for number in range(1000 * block, 1000 * block + size)
    ]
    inner: Any = ModbusStation(station=1, framing="rtu" if kind is ModbusRtu else "ascii")
    for tag in tags:
        n = tag.address.number
        inner.memory.animate("holding", n, lambda at, n=n: clock_word(at, n))
    station = Unruly(inner, 3, late=late, wire=WIRE)
    timing: Timing = driver.timing
    device = made_device(
        "slave",
        driver,
        WIRE,
        Timing(TIMEOUT, timing.turnaround, timing.silence, timing.silence_chars, retries=9),
        tuple(tags),
        0.2,
    )
    served = await serve_on_pty([station], WIRE)
    try:
        line = Plant([device], [station], PtyBench(path=served.address), WIRE)
        witness = Witness(line)
        async with running(line):
            await asyncio.sleep(SECONDS)  # a fixed run
            async with asyncio.timeout(300):  # and on a slow machine until it saw enough
                while witness.right <= 100 or device.record.late <= 10:
                    await asyncio.sleep(0.1)
    finally:
        await served.close()
    assert witness.wrong == []


def late(chance: random.Random) -> float:
    return TIMEOUT + chance.uniform(0.05, 0.15) if chance.random() < 0.25 else 0.0
