"""A Zenoh consumer that misses nothing: `python examples/catch_up.py --connect tcp/127.0.0.1:7447`.

It prints every sample of the tags with `history: true` once: `time key value`, in the order of
time, until Ctrl-C. After a router, the network or a gateway was away, it queries the missed samples
by `_time`. Copy it, and replace the print in `main` with your own work.

It works in three steps:

1. It subscribes first and queries history afterwards, so that it loses nothing in between.
2. It checks for missed samples after every change of a link or a gateway, and once a minute,
   because an overloaded network may also drop samples. A check holds back new samples, queries page
   by page everything that was recorded since the last complete page, and leaves out known samples.
3. A page is complete if it has as many samples as the gateways counted and no error, if every
   gateway is still there afterwards, and if no link changed meanwhile. Otherwise the check is
   repeated from the last complete page.
"""

import argparse
import json
import queue
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

import zenoh

CHECK_EVERY = 60.0  # seconds between two checks without a known gap
FIRST_PAGE = 1000  # samples, so that the first ones arrive soon
PAGE = 40_000  # samples of all gateways; over a slow link take fewer, so that it arrives in time
MOST_REPLIES = 1_000_000  # that wait; Zenoh reads nothing more from the link when it is full
ANSWER_WITHIN = 30.0  # seconds for a page
RETRY_EVERY = 0.5  # seconds until an incomplete check is repeated
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


class Page(NamedTuple):
    """The complete answer to one query."""

    samples: list[Sample]
    is_last: bool


class Answer:
    """One query on its way. Its replies wait in Zenoh: a Python callback would hold them up while
    the page before is delivered."""

    def __init__(self, session: zenoh.Session, selector: str) -> None:
        self._replies = session.get(
            selector,
            zenoh.handlers.FifoChannel(MOST_REPLIES),
            timeout=ANSWER_WITHIN,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
        )

    def replies(self) -> Iterator[zenoh.Reply | None]:
        """Yields each reply, and None when it waits for the next one."""
        while True:
            try:
                reply = self._replies.try_recv()
            except zenoh.ZError:  # the last one has been received
                return
            yield reply
            if reply is None:
                time.sleep(0.01)


class CatchUp:
    """All samples under a prefix, each once. `since`: RFC 3339, the time of the first sample."""

    def __init__(self, session: zenoh.Session, prefix: str, since: str) -> None:
        self.since = since  # everything before is delivered: keep it to continue after a restart
        self._begin = since
        self._session = session
        self._prefix = prefix
        self._arrived: queue.Queue[object] = queue.Queue()
        self._gateways: set[str] = set()
        self._links = 0  # changes so far
        self._places: dict[str, str] = {}  # of each gateway: the end of the last complete page
        # Delivered during the present check and after it, and before that.
        self._known: tuple[set[Sample], set[Sample]] = set(), set()
        self._last: dict[str, Sample] = {}  # the last delivered sample of each key
        self._declared = [
            session.declare_subscriber(f"{prefix}/**", self._value),
            session.liveliness().declare_subscriber(
                f"{prefix}/@gateway/*", self._gateway, history=True
            ),
            session.info.declare_transport_events_listener(self._link),
        ]

    # Zenoh's threads call these: they only record the change.

    def _value(self, received: zenoh.Sample) -> None:
        # A copy: a sample of Zenoh keeps the whole batch, up to 64 kB, in which it arrived.
        self._arrived.put(_sample(str(received.key_expr), received))

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
        due = time.monotonic() + RETRY_EVERY  # the network tells its links and gateways first
        while True:
            if time.monotonic() >= due:
                try:
                    for page in self._missed():
                        yield from self._new(sorted(page.samples), may_return=page.is_last)
                except Gap:
                    due = time.monotonic() + RETRY_EVERY
                else:
                    due = time.monotonic() + CHECK_EVERY
                    self._advance()
            try:
                arrived = self._arrived.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                continue
            if due - time.monotonic() <= RETRY_EVERY:
                # A check is due: this sample is in history too, and arrives in its place.
                continue
            if isinstance(arrived, Sample) and not self._may_be_known(arrived):
                yield from self._new([arrived], may_return=True)
                continue
            due = time.monotonic() + RETRY_EVERY  # links change together

    def _may_be_known(self, sample: Sample) -> bool:
        """Returns True if only history can tell: a page before the last one may have had it."""
        last = self._last.get(sample.key)
        if last is None or sample.time > last.time or sample == last:
            return False
        return not any(sample in known for known in self._known)

    def _missed(self) -> Iterator[Page]:
        """Yields every sample since the last complete page, in pages. Raises `Gap` if some may
        lack."""
        links = self._links
        answer = self._query(FIRST_PAGE)
        while True:
            page = self._page(answer, links)
            if not page.is_last:
                answer = self._query(PAGE)  # it arrives while this page is delivered
            yield page
            if page.is_last:
                return

    def _query(self, size: int) -> Answer:
        of_each = max(1, size // max(1, len(self._gateways)))  # every gateway sends as many
        selector = f"{self._prefix}/**?_time=[{self._begin}..];page={of_each}"
        if self._places:
            selector += f";after={','.join(self._places.values())}"
        return Answer(self._session, selector)

    def _page(self, answer: Answer, links: int) -> Page:
        """Waits for a page and notes its end. Raises `Gap` when a link changes, or replies lack."""
        samples, ends = list[Sample](), dict[str, Any]()
        for reply in answer.replies():
            if links != self._links:
                raise Gap
            if reply is None:
                continue
            received = reply.ok
            if received is None:
                raise Gap(reply.err)
            key = str(received.key_expr)
            if key.endswith("/page") and "/@gateway/" in key:
                ends[key.removesuffix("/page")] = json.loads(received.payload.to_bytes())
            else:
                samples.append(_sample(key, received))
        silent = self._gateways - ends.keys()  # in a standby group only one answers
        if not ends or not all(map(self._is_there, silent)) or links != self._links:
            raise Gap
        if len(samples) != sum(end["samples"] for end in ends.values()):
            raise Gap
        for gateway, end in ends.items():
            self._places[gateway] = end["next"]
            if "damaged" in end:
                print(f"{gateway}: {end['damaged']}", file=sys.stderr)
        return Page(samples, all(end["complete"] for end in ends.values()))

    def _is_there(self, gateway: str) -> bool:
        """A gateway that is still there did not end in the middle of its answer."""
        replies = self._session.get(f"{gateway}/status", timeout=ANSWER_WITHIN)
        return any(reply.ok is not None for reply in replies)

    def _new(self, samples: list[Sample], *, may_return: bool) -> Iterator[Sample]:
        """`may_return`: a later page may have the samples too."""
        known, before = self._known
        for sample in samples:
            last = self._last.get(sample.key)
            if sample in known or sample in before or sample == last:
                continue
            if may_return:
                known.add(sample)
            late = last is not None and sample.time < last.time
            if not late:
                self._last[sample.key] = sample
            yield sample._replace(late=True) if late else sample

    def _advance(self) -> None:
        """A check was complete: samples that were delivered before the last one cannot return."""
        self._known = set(), self._known[0]
        if self._last:
            newest = datetime.fromisoformat(max(sample.time for sample in self._last.values()))
            since = (newest - MARGIN).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
            self.since = max(self.since, since)


def _sample(key: str, received: zenoh.Sample) -> Sample:
    """Reads a sample. With `payload: raw` quality and time are in the attachment."""
    payload, about = received.payload.to_string(), received.attachment
    if about is not None:
        known = payload if received.kind == zenoh.SampleKind.PUT else None
        payload = json.dumps({"value": known, **json.loads(about.to_string())})
    return Sample(json.loads(payload)["time"], key, payload)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--connect", required=True, nargs="+", help="e.g. tcp/127.0.0.1:7447; others are spare"
    )
    parser.add_argument("--prefix", default="plant")
    parser.add_argument("--since", help="e.g. 2026-11-20T12:00:00Z (now, when left out)")
    given = parser.parse_args()
    since = given.since or datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    with opened(*given.connect) as session:
        for sample in CatchUp(session, given.prefix, since).samples():
            late = " late" if sample.late else ""
            print(f"{sample.time} {sample.key} {sample.value}{late}", flush=True)


def opened(*endpoints: str) -> zenoh.Session:
    """Opens a session, and waits for a router. Zenoh reconnects an open session by itself."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps(endpoints))
    config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 2000}')
    config.insert_json5("scouting/multicast/enabled", "false")
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            print(f"waiting for {endpoints}: {error}", file=sys.stderr)
            time.sleep(RETRY_EVERY)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
