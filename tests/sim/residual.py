"""Wrong values that pass every check, by bit error rate: counted, beside what theory allows.

    python -m tests.sim.residual --seconds 20

The driver reads a block of eight words from the simulated station again and again, through bit
errors in both directions and without a line. This measures frames and check sums alone.
`tests/sim/twice.py` counts the wrong values that remain when each block is read twice.

Theory: every pattern of the fewest errors that can pass is tried on the reply once, and counted;
the share of wrong values is that number times the chance of one such pattern.
"""

import argparse
import asyncio
import itertools
import json
import random
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

from gateway.errors import DeviceError, NoReply
from gateway.line.polling import read_with_care
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Address, AnyDriver, Span
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from tests.sim.noise import Format, Noise, spoil
from tests.sim.plant import made_device, make_tag

RATES = (1e-5, 1e-4, 1e-3)
WORDS = [0x1234, 0xFFFF, 0x0000, 0xA5A5, 0x0BAD, 100, 42, 0x8001]


@dataclass(frozen=True)
class Case:
    name: str
    driver: AnyDriver
    span: Span
    shape: Format


CASES = (
    Case("vigor 7E1", Vigor(station=1), Span("D", 100, 8), Format(7, parity=True)),
    Case("vigor 8N1", Vigor(station=1), Span("D", 100, 8), Format(8)),
    Case("computer-link 7E1", ComputerLink(station=1), Span("D", 100, 8), Format(7, parity=True)),
    Case("computer-link 8N1", ComputerLink(station=1), Span("D", 100, 8), Format(8)),
    Case("modbus-ascii 7E1", ModbusAscii(station=1), Span("holding", 100, 8), Format(7, True)),
    Case("modbus-ascii 8N1", ModbusAscii(station=1), Span("holding", 100, 8), Format(8)),
    Case("modbus-rtu 8E1", ModbusRtu(station=1), Span("holding", 100, 8), Format(8, True)),
    Case("modbus-rtu 8N1", ModbusRtu(station=1), Span("holding", 100, 8), Format(8)),
)


Way = Callable[[bytes], bytes]  # the sent bytes as they are received


class Direct:
    """A `Talk` without time: all bytes arrive at once, through the noise."""

    may_echo = False

    def __init__(self, case: Case, ask: Way, hurt: Way) -> None:
        self._case, self._station, self._hurt = case, ask, hurt

    async def tell(self, frame: Any) -> None:
        self._station(self._case.driver.codec().encode(frame))

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], Any]) -> Any:
        codec = self._case.driver.codec()
        heard = self._hurt(self._station(self._hurt(codec.encode(frame))))
        for found in codec.feed(heard):
            answer = answers(found)
            if answer is not None:
                return answer
        raise NoReply("nothing")


def finish(work: Awaitable[Sequence[int]]) -> Sequence[int]:
    """Runs a coroutine that never waits."""
    try:
        work.__await__().send(None)
    except StopIteration as end:
        units: Sequence[int] = end.value
        return units
    raise AssertionError("it waits")


class Bench:
    """One device, one station, and the bit errors between them."""

    def __init__(self, case: Case, hurt: Way) -> None:
        self.case, self.hurt = case, hurt
        self.now = 0.0
        self.station = station_for(case.driver, ())
        area, start, size = case.span
        self.station.memory.write(area, start, WORDS[:size])
        self.right = WORDS[:size]
        addresses = [Address(area, start + n) for n in range(size)]
        tags = [make_tag(case.driver.spell(address), case.driver) for address in addresses]
        wire, timing = WireTiming(19200, 10), case.driver.timing
        self.devices = [
            made_device("plc", case.driver, wire, timing, tags, 0.0, verify_reads=times)
            for times in (1, 2)
        ]
        assert self.devices[0].blocks[0].span == case.span

    def ask(self, data: bytes) -> bytes:
        self.now += 10.0  # the station drops a half request
        return b"".join(self.station.hear(data, self.now))

    def read(self, times: int = 1) -> list[int] | None:
        """Returns the words after `times` equal reads (`verify_reads`), None after an
        error."""
        device = self.devices[times - 1]
        block = device.blocks[0]
        talk = Direct(self.case, self.ask, self.hurt)
        try:
            return list(finish(read_with_care(talk, device, block, span=block.span)))
        except DeviceError:
            self.station.hear(b"\x00" * 300, self.now + 10.0)
            return None


def noisy(case: Case, rate: float, chance: random.Random) -> Way:
    noise = Noise(before=rate)
    return lambda data: spoil(data, noise, case.shape, chance)


def measured(case: Case, rate: float, seconds: float) -> dict[str, int]:
    """Counts for so many seconds."""
    bench = Bench(case, noisy(case, rate, random.Random(f"{case.name} {rate}")))
    seen: Counter[str] = Counter()
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for _ in range(200):
            words = bench.read()
            if words is None:
                seen["noticed"] += 1
            else:
                seen["right" if words == bench.right else "wrong"] += 1
    return dict(seen)


def theory(case: Case) -> tuple[int, int, int]:
    """Returns the fewest errors that can pass, the wrong patterns of so many, and the bits.

    Both ways: in the reply and in the request. Where parity is checked, two bits of each of two
    characters; otherwise two bits of two characters in one place. For a CRC-16 no pattern of
    three or fewer passes in so short a frame; of four about one in 2**15 does.
    """
    bench = Bench(case, bytes)
    request, reply = exchange(bench)
    bits = case.shape.data_bits + case.shape.parity
    total = (len(reply) + len(request)) * case.shape.bits
    if case.driver.protocol == "modbus-rtu":
        patterns = sum(_choose(len(frame) * bits, 4) / 2**15 for frame in (request, reply))
        return 4, int(patterns), total
    return (4 if case.shape.parity else 2), _passing(case, bench, request, reply), total


def exchange(bench: Bench) -> tuple[bytes, bytes]:
    """Returns request and reply without noise."""
    passed: list[bytes] = []
    hurt = bench.hurt

    def note(data: bytes) -> bytes:
        passed.append(data)
        return data

    bench.hurt = note
    assert bench.read() == bench.right
    bench.hurt = hurt
    request, reply = passed
    return request, reply


def _choose(n: int, k: int) -> float:
    chosen = 1.0
    for i in range(k):
        chosen *= (n - i) / (i + 1)
    return chosen


def _passing(case: Case, bench: Bench, request: bytes, reply: bytes) -> int:
    """Counts the patterns on two characters that pass: one bit of each, two with parity."""
    width = case.shape.data_bits + case.shape.parity
    hits = [
        sum(1 << bit for bit in bits)
        for bits in itertools.combinations(range(width), 2 if case.shape.parity else 1)
    ]
    data = (1 << case.shape.data_bits) - 1
    found = 0
    for of_request, frame in ((True, request), (False, reply)):
        for (i, a), (j, b) in itertools.combinations(enumerate(frame), 2):
            # The sum of two characters changes by nothing, or it does not pass.
            for hit in hits:
                for other in hits:
                    if not _same_sum(case, a, b, hit & data, other & data, i, j, frame):
                        continue
                    spoilt = bytearray(frame)
                    spoilt[i] ^= hit & data
                    spoilt[j] ^= other & data
                    found += _believed(bench, request, bytes(spoilt), of_request)
    return found


def _same_sum(
    case: Case, a: int, b: int, hit: int, other: int, i: int, j: int, frame: bytes
) -> bool:
    """Sorts out most patterns quickly, so that few are tried in full."""
    if case.driver.protocol == "modbus-ascii" or j >= len(frame) - 4:
        return True
    return ((a ^ hit) + (b ^ other) - a - b) % 256 == 0


def _believed(bench: Bench, request: bytes, spoilt: bytes, of_request: bool) -> bool:
    """The pattern results in a wrong value."""
    bench.hurt = lambda data: spoilt if (data == request) is of_request else data
    words = bench.read()
    return words is not None and words != bench.right


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="for each rate of each case")
    parser.add_argument("--rates", type=float, nargs="*", default=list(RATES))
    chosen = parser.parse_args()
    for case in CASES:
        fewest, patterns, bits = theory(case)
        for rate in chosen.rates:
            line: dict[str, Any] = {"case": case.name, "rate": rate}
            share = patterns * rate**fewest * (1 - rate) ** (bits - fewest)
            seen = measured(case, rate, chosen.seconds)
            line["readings"] = sum(seen.values())
            line["wrong"] = seen.get("wrong", 0)
            line["share"] = seen.get("wrong", 0) / max(1, sum(seen.values()))
            line |= {"theory": share, "patterns": patterns, "errors": fewest}
            print(json.dumps(line), flush=True)
    return 0


if __name__ == "__main__":
    asyncio.set_event_loop(None)
    sys.exit(main())
