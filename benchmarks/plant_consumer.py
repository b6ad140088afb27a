"""A consumer of a whole plant, for `benchmarks.plant`: checks every value that it receives.

`python -m benchmarks.plant_consumer PREFIX FILE ENDPOINT…` connects as a client. FILE gets the time
and key of each value that arrived. The simulated PLCs of the gateway follow the system's clock, so
the consumer knows the right value of each tag at any time. It shows the values of a device as
unknown from the moment when the token of the device goes, until each of them arrives again. For
each line of standard input it prints a report as JSON about the time since the last one; it ends
with its standard input. Times are of the monotonic clock.
"""

import json
import math
import sys
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

import orjson
import zenoh

from tests.zenoh_peer import configured

# Of the simulated PLC (gateway/simulator/plant.py): a wave between 10 and 90, rounded.
_MIDDLE, _HALF = 50.0, 40.0
# Seconds from the moment of a value in the PLC to its time stamp: the rest of the transaction, and
# the delays of an overloaded machine.
_READ = 1.0
_LOOK = 0.02  # seconds between two looks at what arrived
_AGES_EVERY = 1.0


def is_right(number: int, value: float, at: float) -> bool:
    """`number`: of the tag in its device. `at`: its time stamp, on the monotonic clock."""
    period = 60.0 + 7 * (number % 11)
    middle = at - _READ / 2
    expected = _MIDDLE + _HALF * math.sin(2 * math.pi * middle / period + number)
    steepest = _HALF * 2 * math.pi / period
    return abs(value - expected) <= 1.0 + steepest * _READ


@dataclass
class Known:
    """A gateway, or a pair, as the consumer knows it. Counts begin at the last report."""

    # Good values by device, with their time stamps; and the gateways that serve each device.
    good: defaultdict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    served_by: defaultdict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    last: float = 0.0
    arrived: int = 0
    longest_gap: float = 0.0
    # When the numbers changed: devices that are served, values that are shown.
    devices: list[tuple[float, int]] = field(default_factory=list)
    shown: list[tuple[float, int]] = field(default_factory=list)

    def note(self, at: float) -> None:
        served = [device for device, by in self.served_by.items() if by]
        _note(self.devices, at, len(served))
        _note(self.shown, at, sum(len(self.good[device]) for device in served))

    def ages(self, now: float) -> Iterator[float]:
        """Yields the age of the oldest shown value of each device."""
        for device, by in self.served_by.items():
            if by and self.good[device]:
                yield now - min(self.good[device].values())

    def report(self, now: float) -> dict[str, Any]:
        found = {
            "arrived": self.arrived,
            "longest_gap": max(self.longest_gap, now - self.last),
            "devices": self.devices.copy(),
            "shown": self.shown.copy(),
        }
        self.arrived, self.longest_gap = 0, 0.0
        self.devices, self.shown = self.devices[-1:], self.shown[-1:]
        return found


def _note(numbers: list[tuple[float, int]], at: float, number: int) -> None:
    if not numbers or numbers[-1][1] != number:
        numbers.append((at, number))


class Consumer:
    def __init__(self, file: TextIO) -> None:
        """`file`: for time and key of each value that arrived."""
        self._file = file
        self._offset = time.time() - time.monotonic()
        self._arrivals: deque[tuple[float, str, bytes | None]] = deque()
        self._gateways: defaultdict[str, Known] = defaultdict(Known)
        self._newest: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._late: list[float] = []
        self._oldest = 0.0
        self._aged = time.monotonic()
        self._lock = threading.Lock()

    # Zenoh's threads call these.

    def value(self, sample: zenoh.Sample) -> None:
        arrival = time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()
        self._arrivals.append(arrival)

    def token(self, sample: zenoh.Sample) -> None:
        sign = "+" if sample.kind == zenoh.SampleKind.PUT else "-"
        self._arrivals.append((time.monotonic(), sign + str(sample.key_expr), None))

    # The consumer's own threads call these.

    def work(self) -> None:
        while True:
            time.sleep(_LOOK)
            with self._lock:
                changed = set[str]()
                while self._arrivals:
                    at, key, payload = self._arrivals.popleft()
                    if payload is None:
                        self._token_changed(at, key)
                    else:
                        changed.add(self._value_arrived(at, key, payload))
                now = time.monotonic()
                for name in changed:
                    self._gateways[name].note(now)
                if now - self._aged > _AGES_EVERY:
                    self._aged = now
                    ages = (age for known in self._gateways.values() for age in known.ages(now))
                    self._oldest = max(self._oldest, *ages, 0.0)

    def _token_changed(self, at: float, event: str) -> None:
        """A key is `<prefix>/@gateway/<gateway>/alive/<device>`."""
        *_, gateway, _, device = event.split("/")
        known = self._gateways[device.partition("-")[0]]
        if event[0] == "+":
            known.served_by[device].add(gateway)
        else:
            known.served_by[device].discard(gateway)
            if not known.served_by[device]:
                known.good[device].clear()
        known.note(at)

    def _value_arrived(self, at: float, key: str, payload: bytes) -> str:
        """Returns the name of the gateway. A key is `<prefix>/<gateway>-<line>-<device>/t<n>`."""
        _, device, tag = key.rsplit("/", 2)
        name = device.partition("-")[0]
        known = self._gateways[name]
        known.arrived += 1
        if known.last:
            known.longest_gap = max(known.longest_gap, at - known.last)
        known.last = at
        document = orjson.loads(payload)
        stamp = document["time"]
        self._file.write(f"{stamp} {key}\n")
        good, newest = known.good[device], self._newest.get(key, "")
        if stamp < newest:
            self._counts["older"] += 1
            return name
        self._counts["again" if stamp == newest else document["quality"]] += 1
        self._newest[key] = stamp
        if document["quality"] != "good":
            good.pop(key, None)
            return name
        taken = datetime.fromisoformat(stamp).timestamp() - self._offset
        if not is_right(int(tag[1:]), document["value"], taken):
            self._counts["wrong"] += 1
            print(f"wrong: {key} {payload!r} at {taken}", file=sys.stderr)
        if stamp != newest:
            self._late.append(at - taken)
        good[key] = taken
        return name

    def report(self) -> dict[str, Any]:
        with self._lock:
            self._file.flush()
            now = time.monotonic()
            found = {
                "time": now,
                "gateways": {name: known.report(now) for name, known in self._gateways.items()},
                "counts": dict(self._counts),
                "late": _quantiles(self._late),
                "oldest": self._oldest,
            }
            self._counts.clear()
            self._late.clear()
            self._oldest = 0.0
            return found


def _quantiles(late: list[float]) -> list[float]:
    """Returns the median, the 99th percentile and the largest."""
    ordered = sorted(late) or [0.0]
    return [ordered[len(ordered) // 2], ordered[int(len(ordered) * 0.99)], ordered[-1]]


def main(prefix: str, path: str, *endpoints: str) -> None:
    setup = {"mode": "client", "listen": [], "connect": list(endpoints), "config": {}}
    with Path(path).open("w", encoding="utf-8") as file, zenoh.open(configured(setup)) as session:
        consumer = Consumer(file)
        value = zenoh.handlers.Callback(consumer.value, indirect=False)
        token = zenoh.handlers.Callback(consumer.token, indirect=False)
        declared = [
            session.declare_subscriber(f"{prefix}/**", value),
            session.liveliness().declare_subscriber(
                f"{prefix}/@gateway/*/alive/*", token, history=True
            ),
        ]
        threading.Thread(target=consumer.work, daemon=True).start()
        print("ready", flush=True)
        for _ in sys.stdin:
            print(json.dumps(consumer.report()), flush=True)
        del declared


if __name__ == "__main__":
    main(*sys.argv[1:])
