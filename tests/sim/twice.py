"""Counts the wrong values that pass every check in spite of `verify_reads: 2`.

    python -m tests.sim.twice --readings 300000

One word is read through bit errors by `read_with_care` of the gateway. A wrong value passes twice
only if the same wrong words come twice: with p(v) for each wrong value v, once is p = sum of p(v),
twice is the sum of p(v)**2, which is at most p**2.

* Importance sampling: most exchanges have no bit error, or too few for a wrong value (every single
  one was tried). Only exchanges with enough errors are drawn, as they come at this bit error rate,
  and what is counted is multiplied by how often such an exchange happens.
* All pairs: two readings in a row are two independent draws. So are any two of all those that were
  drawn: what every two wrong ones heard is put through `read_with_care` with `verify_reads` 2, and
  the pairs that it believes are counted, of all pairs.
* In a row: where it is frequent enough, readings with `verify_reads` 2 are simply counted.

Theory: every pattern of one and of two errors, on all bits of request and reply, was tried.
Intervals are of 95 %.
"""

import argparse
import itertools
import json
import math
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusAscii
from gateway.protocols.vigor import Vigor
from tests.sim.noise import Format, flips, strike
from tests.sim.residual import Bench, Case, exchange, noisy

PLAIN = Format(8)
BARE = Case(
    "computer-link 8N1, no sum",
    ComputerLink(station=1, sum_check=False),
    Span("D", 100, 1),
    PLAIN,
)
CASES = (
    Case("vigor 8N1", Vigor(station=1), Span("D", 100, 1), PLAIN),
    Case("computer-link 8N1", ComputerLink(station=1), Span("D", 100, 1), PLAIN),
    Case("modbus-ascii 8N1", ModbusAscii(station=1), Span("holding", 100, 1), PLAIN),
    BARE,
)
RATES = (1e-4, 1e-3, 3e-3)
MOST_PAIRED = 500  # wrong reads that are paired
Words = tuple[int, ...]


class Share(NamedTuple):
    """A probability with its interval, from `hits`."""

    value: float
    low: float
    high: float
    hits: int

    def times(self, weight: float) -> "Share":
        return Share(weight * self.value, weight * self.low, weight * self.high, self.hits)


@dataclass
class Theory:
    """The number of patterns of one and two errors for each wrong value."""

    bits: int
    ways: dict[Words, Counter[int]]

    @property
    def fewest(self) -> int:
        return min(errors for ways in self.ways.values() for errors in ways)

    def shares(self, rate: float) -> tuple[float, float]:
        """Returns the shares for one and for two reads at this bit error rate."""
        each = [
            sum(n * rate**k * (1 - rate) ** (self.bits - k) for k, n in ways.items())
            for ways in self.ways.values()
        ]
        return sum(each), sum(p * p for p in each)


class Struck:
    """A transaction with chosen errors: bits of the request, then of the reply."""

    def __init__(self, case: Case, rate: float, chance: random.Random) -> None:
        self.bench = Bench(case, self._hurt)
        self._shape, self._rate, self._chance = case.shape, rate, chance
        request, reply = exchange(self.bench)
        self._request, self._reply = (len(part) * case.shape.bits for part in (request, reply))
        self.bits = self._request + self._reply
        self._struck: Sequence[int] = ()
        self.heard: list[bytes] = []

    def read(self, struck: Sequence[int]) -> Words | None:
        """Returns the wrong words that pass; None for no words, or the right ones."""
        self._struck, self.heard = struck, []
        words = self.bench.read()
        return None if words is None or words == self.bench.right else tuple(words)

    def _hurt(self, data: bytes) -> bytes:
        size = len(data) * self._shape.bits
        if not self.heard:  # the request
            mine = [bit for bit in self._struck if bit < self._request]
        else:
            mine = [bit - self._request for bit in self._struck if bit >= self._request]
            mine = [bit for bit in mine if bit < size]
            if size > self._reply and self._rate:  # a misread request may have a longer reply
                more = flips(size - self._reply, self._rate, self._chance)
                mine += [self._reply + bit for bit in more]
        self.heard.append(strike(data, mine, self._shape))
        return self.heard[-1]


def theory(case: Case) -> Theory:
    struck = Struck(case, 0.0, random.Random(0))
    ways: dict[Words, Counter[int]] = defaultdict(Counter)
    for errors in (1, 2):
        for pattern in itertools.combinations(range(struck.bits), errors):
            words = struck.read(pattern)
            if words is not None:
                ways[words][errors] += 1
    return Theory(struck.bits, dict(ways))


class Counted(NamedTuple):
    once: Share
    twice: Share
    weight: float  # how often a transaction has at least so many errors


def counted(case: Case, rate: float, fewest: int, readings: int, seed: str = "") -> Counted:
    """Counts one read, and two of all pairs. `fewest`: errors of each drawn transaction."""
    chance = random.Random(f"{case.name} {rate} {seed}")
    struck = Struck(case, rate, chance)
    numbers, weights = _at_least(fewest, struck.bits, rate)
    wrong: list[tuple[Words, list[bytes]]] = []
    for errors in chance.choices(numbers, weights, k=readings):
        words = struck.read(chance.sample(range(struck.bits), errors))
        if words is not None:
            wrong.append((words, struck.heard))
    weight = sum(weights)
    some = wrong[:MOST_PAIRED]
    # As if the reads had ended with the last wrong one that was paired.
    drawn = readings * len(some) / len(wrong) if wrong else readings
    twice = _of_all_pairs(_believed_pairs(case, some), drawn)
    return Counted(_of(len(wrong), readings).times(weight), twice.times(weight**2), weight)


def _of(hits: int, readings: int) -> Share:
    """Returns Wilson's interval."""
    z = 1.96
    share, more = hits / readings, z * z / readings
    middle = (share + more / 2) / (1 + more)
    within = z * math.sqrt((share * (1 - share) + more / 4) / readings) / (1 + more)
    return Share(share, max(0.0, middle - within), middle + within, hits)


def _at_least(fewest: int, bits: int, rate: float) -> tuple[list[int], list[float]]:
    """Returns numbers of errors and the share of transactions with so many."""
    numbers = range(fewest, min(bits, fewest + 60) + 1)
    return list(numbers), [math.comb(bits, k) * rate**k * (1 - rate) ** (bits - k) for k in numbers]


def _believed_pairs(case: Case, wrong: Sequence[tuple[Words, list[bytes]]]) -> list[int]:
    """Counts for each wrong read the others that are equal when the gateway reads twice."""
    again: Iterator[bytes] = iter(())
    bench = Bench(case, lambda _data: next(again))
    believed = [0] * len(wrong)
    for (i, (first, one)), (j, (second, other)) in itertools.combinations(enumerate(wrong), 2):
        again = iter((*one, *other))
        if bench.read(times=2) is not None:
            assert first == second
            believed[i] += 1
            believed[j] += 1
    return believed


def _of_all_pairs(believed: Sequence[int], readings: float) -> Share:
    """Returns the share of all pairs: a U-statistic, by the spread of each read's share."""
    pairs = readings * (readings - 1) / 2
    hits = sum(believed) // 2
    mean = hits / pairs
    each = [b / (readings - 1) for b in believed]
    spread = sum((e - mean) ** 2 for e in each) + (readings - len(each)) * mean**2
    variance = 4 * spread / (readings - 1) / readings + mean / pairs
    within = 1.96 * math.sqrt(variance)
    return Share(mean, max(0.0, mean - within), mean + within, hits)


def in_a_row(case: Case, rate: float, readings: int) -> Share:
    """Counts reads with `verify_reads: 2`, without weights."""
    bench = Bench(case, noisy(case, rate, random.Random(f"row {case.name} {rate}")))
    return _of(
        sum(bench.read(times=2) not in (None, bench.right) for _ in range(readings)), readings
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readings", type=int, default=300_000, help="for each rate of each case")
    parser.add_argument("--rates", type=float, nargs="*", default=list(RATES))
    chosen = parser.parse_args()
    for case in CASES:
        known = theory(case)
        for rate in chosen.rates:
            once, twice = known.shares(rate)
            found = counted(case, rate, known.fewest, chosen.readings)
            line = {
                "case": case.name,
                "rate": rate,
                "weight": found.weight,
                "once": found.once,
                "theory once": once,
                "twice": found.twice,
                "square": found.once.value**2,
                "theory twice": twice,
            }
            if case is BARE:
                line["in a row"] = in_a_row(case, rate, chosen.readings)
            print(json.dumps(line), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
