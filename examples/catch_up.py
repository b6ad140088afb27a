"""A Zenoh consumer that misses nothing: `python examples/catch_up.py --connect tcp/127.0.0.1:7447`.

It prints every sample of the tags with `history: true` once: `time key value`, in the order of
time, until Ctrl-C. After a router, the network or a gateway was away, it queries the missed samples
by `_time`. Copy it, and replace the print in `main` with your own work.

It works in three steps:

1. It subscribes first and queries history afterwards, so that it loses nothing in between.
2. It checks for missed samples after every change of a link or a gateway, and once a minute,
   because an overloaded network may also drop samples. A check holds back new samples, queries
   everything since the last complete answer, sorts it, and leaves out known samples.
3. An answer is complete if it has a sample and no error, if every gateway is still there
   afterwards, and if no link changed meanwhile. Otherwise the check is repeated.
"""

import argparse
import json
import queue
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import zenoh

CHECK_EVERY = 60.0  # seconds between two checks without a known gap
ANSWER_WITHIN = 60.0  # seconds for the whole answer to a check
RETRY_EVERY = 1.0  # seconds until an incomplete check is repeated
# Samples of different lines may be recorded a moment after their time.
MARGIN = timedelta(seconds=5)
MISSED = object()  # in the queue: samples may be missing


class Sample(NamedTuple):
    """Sorts by time: the gateway writes times so that their texts sort."""

    time: str
    key: str
    payload: str  # JSON: value, quality, time, and the reason of a bad one
    late: bool = False  # found by a check, after newer samples of its tag were delivered

    @property
    def value(self) -> object:
        return json.loads(self.payload)["value"]


class Gap(Exception):
    """The answer was not complete."""


class CatchUp:
    """All samples under a prefix, each once. `since`: RFC 3339, the time of the first sample."""

    def __init__(self, session: zenoh.Session, prefix: str, since: str) -> None:
        self.since = since  # everything before is delivered: keep it to continue after a restart
        self._session = session
        self._prefix = prefix
        self._arrived: queue.Queue[object] = queue.Queue()
        self._gateways: set[str] = set()
        self._links = 0  # changes so far
        self._known: set[Sample] = set()  # delivered, and not older than `since`
        self._last: dict[str, Sample] = {}  # the last delivered sample of each key
        self._declared = [
            session.declare_subscriber(f"{prefix}/**", self._arrived.put),
            session.liveliness().declare_subscriber(
                f"{prefix}/@gateway/*", self._gateway, history=True
            ),
            session.info.declare_transport_events_listener(self._link),
        ]

    # Zenoh's threads call these: they only record the change.

    def _gateway(self, token: zenoh.Sample) -> None:
        key = str(token.key_expr)
        if token.kind == zenoh.SampleKind.PUT:
            self._gateways.add(key)
        else:
            self._gateways.discard(key)
        self._links += 1
        self._arrived.put(MISSED)

    def _link(self, _event: zenoh.TransportEvent) -> None:
        self._links += 1
        self._arrived.put(MISSED)

    # Your thread calls these.

    def samples(self) -> Iterator[Sample]:
        """Yields samples for ever."""
        due = time.monotonic()
        while True:
            if time.monotonic() >= due:
                try:
                    yield from self._new(self._missed())
                except Gap:
                    due = time.monotonic() + RETRY_EVERY
                else:
                    due = time.monotonic() + CHECK_EVERY
                    self._advance()
            try:
                arrived = self._arrived.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                continue
            if arrived is MISSED:
                due = min(due, time.monotonic() + RETRY_EVERY)  # links change together
            elif isinstance(arrived, zenoh.Sample):
                if due - time.monotonic() <= RETRY_EVERY:
                    # A check is due: this sample is in history too, and arrives in its place.
                    continue
                yield from self._new([_sample(arrived)])

    def _missed(self) -> list[Sample]:
        """Returns every sample since the last complete check. Raises `Gap` if some may lack."""
        links, gateways = self._links, set(self._gateways)
        selector = f"{self._prefix}/**?_time=[{self.since}..]"
        found = [_sample(answer) for answer in self._answers(selector, links)]
        # The number of samples is unknown. A gateway that is still there did not end in the middle
        # of its answer.
        for gateway in gateways:
            if not any(self._answers(f"{gateway}/status", links)):
                raise Gap(gateway)
        if not found or not gateways or links != self._links:
            raise Gap
        return sorted(found)

    def _answers(self, selector: str, links: int) -> Iterator[zenoh.Sample]:
        """Yields the replies. Raises `Gap` when a link changes: replies may be lost then."""
        answers: queue.Queue[zenoh.Reply | None] = queue.Queue()
        handler = zenoh.handlers.Callback(answers.put, lambda: answers.put(None), indirect=False)
        self._session.get(selector, handler, timeout=ANSWER_WITHIN)
        while links == self._links:
            try:
                reply = answers.get(timeout=0.1)
            except queue.Empty:
                continue
            if reply is None:
                return
            if reply.ok is None:
                raise Gap(reply.err)
            yield reply.ok
        raise Gap

    def _new(self, samples: list[Sample]) -> Iterator[Sample]:
        for sample in samples:
            last = self._last.get(sample.key)
            if sample in self._known or sample == last:
                continue
            self._known.add(sample)
            late = last is not None and sample.time < last.time
            if not late:
                self._last[sample.key] = sample
            yield sample._replace(late=late)

    def _advance(self) -> None:
        newest = datetime.fromisoformat(max(sample.time for sample in self._last.values()))
        since = (newest - MARGIN).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        self.since = max(self.since, since)
        self._known = {sample for sample in self._known if sample.time >= self.since}


def _sample(received: zenoh.Sample) -> Sample:
    """Reads a sample. With `payload: raw` quality and time are in the attachment."""
    payload, about = received.payload.to_string(), received.attachment
    if about is not None:
        known = payload if received.kind == zenoh.SampleKind.PUT else None
        payload = json.dumps({"value": known, **json.loads(about.to_string())})
    return Sample(json.loads(payload)["time"], str(received.key_expr), payload)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", required=True, help="e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--prefix", default="plant")
    parser.add_argument("--since", help="e.g. 2026-11-20T12:00:00Z (now, when left out)")
    given = parser.parse_args()
    since = given.since or datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    with opened(given.connect) as session:
        for sample in CatchUp(session, given.prefix, since).samples():
            late = " late" if sample.late else ""
            print(f"{sample.time} {sample.key} {sample.value}{late}", flush=True)


def opened(endpoint: str) -> zenoh.Session:
    """Opens a session, and waits for the router. Zenoh reconnects an open session by itself."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 2000}')
    config.insert_json5("scouting/multicast/enabled", "false")
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            print(f"waiting for {endpoint}: {error}", file=sys.stderr)
            time.sleep(RETRY_EVERY)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
