"""The clients of `benchmarks.scenarios`, each a process: a consumer, and a writer.

`consume ENDPOINT LINES UNITS TAGS TYPE` keeps what arrives and checks it afterwards against the
record of the slaves, so that the check takes no time from the gateway. `write ENDPOINT LINES
SECONDS RATE` writes and measures, after a line of input. Both speak JSON lines. Times are of the
monotonic clock.
"""

import json
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

import orjson
import zenoh

from benchmarks.start import session as opened

_TIME_BITS = 14  # of a number: milliseconds
_TIME = (1 << _TIME_BITS) - 1
# Seconds of the record before the first checked one, at least, and rounds: the values that arrive.
_BEFORE, _ROUNDS = 12.0, 1.6
_OLDEST = 1.0  # seconds that a time stamp may be older than the reply
_CLOCKS = 0.005  # seconds that the wall clock may be corrected meanwhile
WRITABLE = 60_000


def percentile(values: Sequence[float], share: float) -> float | None:
    return values[min(len(values) - 1, int(len(values) * share))] if values else None


def in_uint32(value: float, place: int) -> int | None:
    """Returns the milliseconds in a number of the slave; None: it is not of this place."""
    number = int(value)
    ms = number & _TIME
    return ms if (number ^ (ms * 40503 & 0xFFFF) << 16) >> _TIME_BITS == place else None


def in_float32(value: float, place: int) -> int | None:
    number = round(value * 64)
    mark = (place * 2654435761 & 0xFFFFFFFF) >> 22
    return number & _TIME if number >> _TIME_BITS == mark else None


IN: dict[str, Callable[[float, int], int | None]] = {"uint32": in_uint32, "float32": in_float32}


class Consumer:
    """Receives the values of all tags."""

    def __init__(self, lines: int, units: int, tags: int, kind: str) -> None:
        self._decode = IN[kind]
        self._places = {
            f"plant/d{line}-{unit}/t{tag}": (line * units + unit - 1) * tags + tag
            for line in range(lines)
            for unit in range(1, units + 1)
            for tag in range(tags)
        }
        self._good = set[str]()
        self.complete = threading.Event()
        self.completed = 0.0
        self._arrived: list[tuple[str, bytes, float]] = []
        self._keeps = False

    def heard(self, sample: zenoh.Sample) -> None:
        """Copies the sample: one of Zenoh keeps the batch in which it arrived."""
        if self._keeps:
            payload = sample.payload.to_bytes()
            self._arrived.append((str(sample.key_expr), payload, time.monotonic()))
        elif not self.complete.is_set() and b'"good"' in sample.payload.to_bytes():
            key = str(sample.key_expr)
            if key in self._places:
                self._good.add(key)
                if len(self._good) == len(self._places):
                    self.completed = time.monotonic()
                    self.complete.set()

    def block(self, sample: zenoh.Sample) -> None:
        if not (self._keeps or not self.complete.is_set()):
            return
        device, now = str(sample.key_expr).rpartition("/")[0], time.monotonic()
        for name, fields in orjson.loads(sample.payload.to_bytes()).items():
            key = f"{device}/{name}"
            if self._keeps:
                self._arrived.append((key, orjson.dumps(fields), now))
            elif fields["quality"] == "good" and key in self._places:
                self._good.add(key)
        if len(self._good) == len(self._places) and not self.complete.is_set():
            self.completed = now
            self.complete.set()

    def keep(self) -> None:
        self._keeps = True

    def check(
        self, record: str, begin: float, end: float, *, late: float, changing: bool
    ) -> dict[str, object]:
        """Returns what was wrong of all that arrived. A reply between `begin` and `end` must have
        arrived, with each of its values once; `late`: seconds after it, at least one interval."""
        self._keeps = False
        since = begin - max(_BEFORE, _ROUNDS * late)
        sent = {
            place << _TIME_BITS | ms: at
            for first, count, ms, at in replies(Path(record), since)
            for place in range(first, first + count)
        }
        wall = time.time() - time.monotonic()
        last: dict[int, float] = {}
        seen = Counter[int]()
        found = Counter[str]()
        latencies = []
        for key, payload, arrived in self._arrived:
            place = self._places.get(key)
            if place is None:
                continue
            try:
                fields = orjson.loads(payload)
            except orjson.JSONDecodeError:
                found["wrong"] += 1
                print(f"no JSON on {key} at {arrived - begin:.2f} s: {payload!r}", file=sys.stderr)
                continue
            if fields["quality"] != "good":
                found["bad"] += 1
                continue
            ms = self._decode(fields["value"], place)
            if ms is None:
                found["wrong"] += 1
                continue
            if not changing:
                found["wrong"] += ms != 0
                continue
            token = place << _TIME_BITS | ms
            if (at := sent.get(token)) is None:
                found["wrong"] += arrived > begin  # a value that no reply had
                continue
            stamp = datetime.fromisoformat(fields["time"]).timestamp() - wall
            # It may be older, when the loop of the gateway was late, but never newer.
            found["wrong time"] += not at - _OLDEST <= stamp <= arrived + _CLOCKS
            found["out of order"] += at < last.get(place, at)
            last[place] = at
            if begin <= at < end:
                seen[token] += 1
                if seen[token] == 1:
                    latencies.append(arrived - at)
        due = [token for token, at in sent.items() if begin <= at < end] if changing else []
        latencies.sort()
        return {
            "read": len(due),
            "arrived": len(seen),
            "missing": sum(token not in seen for token in due),
            "twice": seen.total() - len(seen),
            "late": sum(one > late for one in latencies),
            **{name: found[name] for name in ("wrong", "wrong time", "out of order", "bad")},
            "p50": percentile(latencies, 0.5),
            "p99": percentile(latencies, 0.99),
            "max": latencies[-1] if latencies else None,
        }


def replies(record: Path, begin: float) -> Iterator[tuple[int, int, int, float]]:
    """Yields the polls since `begin`: first place, count, milliseconds in the values, seconds.

    A resync after a write reads a part of a poll: it gives no values.
    """
    all_reads = list(struct.iter_unpack("=IIQ", record.read_bytes()))
    polls, end = set[tuple[int, int]](), 0
    for first, count in sorted({row[:2] for row in all_reads}, key=lambda row: (row[0], -row[1])):
        if first + count > end:
            polls.add((first, count))
            end = first + count
    for first, count, at in all_reads:
        if at >= begin * 1e6 and (first, count) in polls:
            yield first, count, at // 1000 & _TIME, at / 1e6


def consume(endpoint: str, lines: int, units: int, tags: int, kind: str) -> None:
    consumer = Consumer(lines, units, tags, kind)
    with opened(endpoint, time.monotonic()) as session:
        session.declare_subscriber("plant/*/*", consumer.heard)
        session.declare_subscriber("plant/*/@block", consumer.block)
        print(json.dumps({"ready": True}), flush=True)
        for text in sys.stdin:
            asked = json.loads(text)
            answer: dict[str, object] = {}
            match asked["do"]:
                case "wait":
                    consumer.complete.wait(asked["within"])
                    answer = {"at": consumer.completed or None}
                case "keep":
                    consumer.keep()
                case "check":
                    asked.pop("do")
                    answer = consumer.check(**asked)
            print(json.dumps(answer), flush=True)


def write(endpoint: str, lines: int, seconds: float, rate: float) -> None:
    """Writes to each line in turn, `rate` times a second."""
    took, failed, done, total = [], 0, 0, 0
    with opened(endpoint, time.monotonic()) as session:
        print("ready", flush=True)
        sys.stdin.readline()
        begun = time.monotonic()
        while (now := time.monotonic()) < begun + seconds:
            value = done % 60_000
            key = f"plant/d{done % lines}-1/w/@set"
            ends = [reply.ok for reply in session.get(key, payload=str(value), timeout=10.0)]
            took.append(time.monotonic() - now)
            if ends and ends[0] is not None:
                total += value
            else:
                failed += 1
            done += 1
            time.sleep(max(0.0, begun + done / rate - time.monotonic()))
    took.sort()
    print(
        json.dumps(
            {
                "writes": done - failed,
                "failed": failed,
                "sum": total,
                "p50": percentile(took, 0.5),
                "p99": percentile(took, 0.99),
                "max": took[-1] if took else None,
            }
        ),
        flush=True,
    )


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["consume", where, lines, units, tags, kind]:
            consume(where, int(lines), int(units), int(tags), kind)
        case ["write", where, lines, seconds, rate]:
            write(where, int(lines), float(seconds), float(rate))
