"""Good values on a noisy wire, against what it could carry: `python -m benchmarks.noise`.

On virtual time, one device of each serial protocol is asked every 20 ms, alone and beside eight
healthy ones that are asked every second. Of its replies a share is lost or has one wrong bit (one
is lost for four that are spoiled). A wire could carry the reads of a master that knows which reply
is lost: a spoiled reply costs its own time, a lost one `reply_timeout`. The last columns are the
share of their polls that the others keep, and the values shown as good that were wrong.
"""

import argparse
import asyncio
import logging
import random
from dataclasses import dataclass, field
from typing import Any

import structlog

from gateway.engine.device.device import Device
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.stations.registry import station_of
from gateway.tags import Quality, Tag
from tests.sim.bench import TURNAROUND, WIRE, Bench
from tests.sim.plant import Plant, clock_word, made_device, make_tag, running
from tests.sim.virtual import now, run_virtual

PROTOCOLS = {
    "Modbus RTU": ModbusRtu,
    "Modbus ASCII": ModbusAscii,
    "Vigor": Vigor,
    "Computer Link": ComputerLink,
}
LOSSES = (0, 5, 10, 25, 40)  # percent
EVERY, HEALTHY, HEALTHY_EVERY, WORDS = 0.02, 8, 1.0, 8
LOST = 0.2  # of the replies that do not arrive; the others are spoiled


@dataclass
class Noisy:
    """A station of whose replies a share is lost or spoiled."""

    inner: Any
    share: float
    wire: WireTiming = WIRE
    replied: list[float] = field(default_factory=list)  # characters of each good reply

    def __post_init__(self) -> None:
        self._random = random.Random(self.inner.station)

    def hear(self, data: bytes, at: float) -> list[bytes]:
        replies: list[bytes] = self.inner.hear(data, at)
        if not replies or self._random.random() >= self.share:
            return replies
        if self._random.random() < LOST:
            return []
        spoilt = bytearray(b"".join(replies))
        spoilt[self._random.randrange(len(spoilt))] ^= 1 << self._random.randrange(7)
        return [bytes(spoilt)]


def noisy_plant(protocol: str, share: float, healthy: int) -> Plant:
    devices, stations = [], []
    for number in range(1 + healthy):
        driver: AnyDriver = PROTOCOLS[protocol](station=number + 1)
        area = "holding:" if "Modbus" in protocol else "D"
        every = HEALTHY_EVERY if number else EVERY
        tags = [
            make_tag(f"{area}{n}", driver, device=f"d{number}", type="uint16", every=every)
            for n in range(10, 10 + WORDS)
        ]
        station: Any = station_of(driver)
        for tag in tags:
            n = tag.address.number
            station.memory.animate(tag.address.area, n, lambda at, n=n: clock_word(at, n))
        devices.append(made_device(f"d{number}", driver, WIRE, driver.timing, tags))
        stations.append(Noisy(station, 0.0 if number else share))
    return Plant(devices, stations, Bench())  # type: ignore[arg-type]  # all have `hear`


def wrong(tag: Tag, value: Any, at: float) -> bool:
    """True for a value that the clock in the station did not have in the last second."""
    behind: int = (clock_word(at, tag.address.number) - value) % 65536
    return behind > 1000


def could_carry(device: Device, share: float, others: float) -> float:
    """Returns the reads a second. `others`: share of the wire that other devices take."""
    cost = device.blocks[0].cost
    took = device.silence.shorter + TURNAROUND + (cost.request + cost.reply) * WIRE.character
    good = max(took, EVERY)
    failed = (1 - LOST) * took + LOST * (took + device.timing.reply_timeout)
    return (1 - others) * (1 - share) / ((1 - share) * good + share * failed)


async def measure(protocol: str, share: float, healthy: int, seconds: float) -> list[str]:
    plant = noisy_plant(protocol, share, healthy)
    device, others = plant.devices[0], plant.devices[1:]
    async with running(plant):
        await asyncio.sleep(5.0)
        since = now()
        await asyncio.sleep(seconds)
    reads = plant.reads(device, since)
    kept = [len(plant.reads(other, since)) * HEALTHY_EVERY / seconds for other in others]
    bad = sum(
        sample.quality is Quality.GOOD and wrong(sample.tag, sample.value, at)
        for at, sample in plant.reported
    )
    costs = [other.seconds(other.blocks[0].cost) for other in others]
    taken = sum(k * cost / HEALTHY_EVERY for k, cost in zip(kept, costs, strict=True))
    carried = could_carry(device, share, taken)
    rate = len(reads) / seconds
    row = [f"{rate:.1f}", f"{carried:.1f}", f"{min(1.0, rate / carried):.2f}"]
    return [*row, f"{min(kept, default=1.0):.2f}", str(bad)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--losses", type=int, nargs="+", default=LOSSES, help="percent")
    parser.add_argument("--protocols", nargs="+", default=list(PROTOCOLS))
    chosen = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    print("| protocol | beside | loss | good/s | could | share | others kept | wrong |")
    print("|---|---|---|---|---|---|---|---|")
    for protocol in chosen.protocols:
        for healthy in (0, HEALTHY):
            for loss in chosen.losses:
                row = run_virtual(measure(protocol, loss / 100, healthy, chosen.seconds))
                print(f"| {protocol} | {healthy} | {loss} % | {' | '.join(row)} |")


if __name__ == "__main__":
    main()
