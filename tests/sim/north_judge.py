"""The rules of the northbound edge: views, answers, records, writes."""

import asyncio
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.northbound.publishing.slow_puts import ROUNDS
from gateway.tags import Quality, Sample
from tests.sim.north_peers import Client
from tests.sim.story import Story
from tests.sim.virtual_zenoh import Received

MOST_TROUBLES = 20
REPAIRED = ROUNDS[-1] + 8.0  # seconds after the last loss that the gateway can notice
DELAYED = 1.0  # seconds in the queues of a link that is not full
ON_WIRE = 0.2  # seconds from the last check of a write to its execution
STORED = 1.0  # seconds until a sample is in the file
NOT_DONE = ("not-sent", "busy", "line-down", "no-reply", "bad-value", "not-writable", "unknown-tag")
NOT_SENT = set(NOT_DONE)
MOST_OUTCOMES = 500  # that every history file of a seed keeps
GATEWAY = "plant/@gateway/sim"


@dataclass(eq=False)
class Attempt:
    """One write. Its value is that of no other write to the tag."""

    tag: str
    value: int
    made: float | None  # the time in its attachment
    by_put: bool
    arrived: float | None = None
    told: str = ""  # an error, or `written`; empty: nothing
    told_at: float = 0.0
    done: list[float] = field(default_factory=list)
    published: list[str] = field(default_factory=list)  # outcomes


@dataclass(eq=False)
class View:
    """The values that a subscriber shows. `disturbed`: the last time when its path lost a value,
    or could have."""

    client: Client
    routed: bool
    shown: dict[str, int] = field(default_factory=dict)  # by tag: the number of its publication
    stamps: dict[str, int] = field(default_factory=dict)
    disturbed: float = float("-inf")

    def shows(self, tag: str) -> bool:
        """The subscriber knows that gateway and device are there."""
        device = tag.partition("/")[0]
        return {GATEWAY, f"{GATEWAY}/alive/{device}"} <= self.client.tokens.keys()


@dataclass(eq=False)
class Judge:
    """Hears of everything, and reports broken rules. Times by the loop's clock."""

    story: Story
    began: float
    refresh: float
    keep: float  # seconds: older samples and outcomes may be gone
    # By tag: when, the value (None: bad), and the time of the sample.
    published: dict[str, list[tuple[float, Any, int]]] = field(default_factory=dict)
    views: list[View] = field(default_factory=list)
    recorded: list[tuple[float, str, int, Any]] = field(default_factory=list)
    attempts: dict[tuple[str, int], Attempt] = field(default_factory=dict)
    lost_at: float = float("-inf")  # a loss that the gateway can notice

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def broke(self, what: str) -> None:
        if len(self.story.broken) < MOST_TROUBLES:
            self.story.broken.append(f"{self.now - self.began:.3f} s: {what}")

    # From the gateway: it calls before the Zenoh side gets the samples

    def publish(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            value = sample.value if sample.quality is Quality.GOOD else None
            entry = self.now, value, sample.time // 1000
            self.published.setdefault(sample.tag.key, []).append(entry)
            self.story.counts["published"] += 1

    def set_online(self, device: str, online: bool) -> None:
        """The views see the tokens."""

    def record(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.tag.publishing.history:
                self.recorded.append((self.now, sample.tag.key, sample.time // 1000, sample.value))

    # Views

    def received(self, view: View, sample: Received) -> None:
        tag = sample.key_expr.removeprefix("plant/")
        document = json.loads(sample.payload.to_bytes())
        if not tag.endswith("/@block"):
            self._shows(view, tag, document, sample.stamp)
            return
        for name, value in document.items():
            self._shows(view, f"{tag.removesuffix('@block')}{name}", value, 0)

    def _shows(self, view: View, tag: str, document: Any, stamp: int) -> None:
        self.story.counts["received"] += 1
        if stamp and stamp <= view.stamps.get(tag, -1):
            self.broke(f"{tag}: the time stamps go back at {view.client.name}")
        view.stamps[tag] = stamp
        number = self._number(tag, document["value"], micros(document["time"]))
        before = view.shown.get(tag, -1)
        if number < before:
            self.broke(f"{tag} goes back to {document['value']!r} at {view.client.name}")
        view.shown[tag] = number

    def _number(self, tag: str, value: Any, time: int) -> int:
        """Returns the first publication of the value that still holds; -1 for the state before the
        first one."""
        log = self.published.get(tag, [])
        for number in range(len(log) - 1, -1, -1):
            if log[number][1] == value and log[number][2] <= time:
                return number
        if value is not None:
            self.broke(f"{tag} arrived as {value!r}, which was never published")
        return -1

    def look(self) -> None:
        """Checks the age of all values that are shown as good."""
        for view in self.views:
            self._disturbances(view)
            for tag, number in view.shown.items():
                log = self.published.get(tag, [])
                if number + 1 >= len(log) or number < 0 or log[number][1] is None:
                    continue
                if not view.shows(tag):
                    continue
                self.story.counts["views of older values"] += 1
                age = self.now - max(log[number + 1][0], view.disturbed)
                limit = self.refresh * 1.05 + 8.0
                if not view.routed and min(age, self.now - self.lost_at) > REPAIRED:
                    limit = min(limit, REPAIRED)
                if age > limit:
                    self.broke(
                        f"{tag} is still shown as good {age:.1f} s after a newer value "
                        f"at {view.client.name}, limit {limit:.0f} s"
                    )
                    view.shown[tag] = len(log) - 1

    def _disturbances(self, view: View) -> None:
        client = view.client
        links = [client.link] if client.at is None else [client.link, client.at.link]
        noticed = links[-1].lost[1]
        self.lost_at = max(self.lost_at, noticed)
        for link in links:
            late = not link.is_up or link.down.oldest() > DELAYED or link.down.slowest > DELAYED
            view.disturbed = max(view.disturbed, link.since, link.lost[1], self.now * late)
            if link.is_up:
                link.down.slowest = 0.0

    # Writes

    def executed(self, tag: str, value: int) -> None:
        attempt = self.attempts.get((tag, value))
        if attempt is None or attempt.arrived is None:
            self.broke(f"write of {value} to {tag} was sent, but never asked for")
            return
        attempt.done.append(self.now)
        self.story.counts["executed"] += 1
        if len(attempt.done) > 1:
            self.broke(f"{tag}: {value} was written twice")
        if attempt.told in NOT_DONE:
            self.broke(f"write of {value} to {tag} was told {attempt.told}, and then done")
        since = min(attempt.arrived, attempt.arrived if attempt.made is None else attempt.made)
        if self.now - since > WRITE_EXPIRY + ON_WIRE:
            self.broke(f"write of {value} to {tag} was done {self.now - since:.1f} s after it")

    def told(self, attempt: Attempt, what: str) -> None:
        attempt.told, attempt.told_at = what, self.now
        self.story.counts[f"told {what}"] += 1
        if what == "written" and not attempt.done:
            self.broke(f"write of {attempt.value} to {attempt.tag} is told as done, and was not")
        if what in NOT_DONE and attempt.done:
            self.broke(f"write of {attempt.value} to {attempt.tag} was done, and told {what}")

    def in_order(self, group: Sequence[Attempt], *, done: bool) -> None:
        """Checks a group that was told. `done`: the answer as a whole is good."""
        times = [min(attempt.done) for attempt in group if attempt.done]
        if times != sorted(times):
            self.broke(f"a group was executed in another order: {group}")
        ends = [attempt.told for attempt in group]
        if done != (set(ends) == {"written"}):
            self.broke(f"the answer to a group is {'good' if done else 'an error'}: {ends}")
        if "not-sent" in ends and set(ends[ends.index("not-sent") :]) != {"not-sent"}:
            self.broke(f"a group went on after a tag that was not sent: {ends}")

    def put(self, key: str, data: bytes) -> None:
        """The gateway puts a document: the outcome of a write?"""
        if key == f"{GATEWAY}/writes":
            outcome = json.loads(data)
            attempt = self._of(outcome)
            if attempt is not None:
                attempt.published.append(outcome["outcome"])

    def _of(self, outcome: Any) -> Attempt | None:
        tag, value = str(outcome.get("key")).removeprefix("plant/"), outcome.get("value")
        return self.attempts.get((tag, value)) if isinstance(value, int) else None

    def at_the_end(self, outcomes: Sequence[Any]) -> None:
        """`outcomes`: all of history."""
        recorded: dict[Attempt, list[str]] = {}
        for outcome in outcomes:
            if (asked := self._of(outcome)) is not None:
                recorded.setdefault(asked, []).append(outcome["outcome"])
        sent = [
            attempt
            for attempt in self.attempts.values()
            if attempt.done or attempt.told == "written" or set(attempt.published) - NOT_SENT
        ]
        for attempt in sent[-MOST_OUTCOMES:]:
            if attempt.arrived is None or attempt.arrived < self.now - self.keep:
                continue
            what = f"write of {attempt.value} to {attempt.tag}"
            found = recorded.get(attempt, [])
            if found != attempt.published and found != ["unclear"]:  # as the gateway ended
                self.broke(f"{what}: recorded as {found}, published as {attempt.published}")
            if attempt.told == "written" and found != ["written"]:
                self.broke(f"{what} was told as done, and recorded as {found}")
            if attempt.done and not {"written", "unclear"} & set(found):
                self.broke(f"{what} was done, and recorded as {found}")

    # History

    def missing(self, found: Sequence[tuple[str, int, Any]], since: float, until: float) -> str:
        """Returns a sentence about a recorded sample that is not in `found`; empty if all are.

        `since`: of the samples; `until`: when they were recorded at the latest.
        """
        there = set(found)
        first = int((max(since, self.now - self.keep) - self.began) * 1e6)
        for at, tag, time, value in self.recorded:
            if at > until:
                break
            if time - BEGIN >= first and (tag, time, value) not in there:
                return f"{tag} = {value!r} of {time - BEGIN} us is not in the answer"
        return ""


def micros(text: str) -> int:
    """Returns the time of a document, in µs since 1970."""
    at = datetime.fromisoformat(text)
    return int(at.timestamp()) * 1_000_000 + at.microsecond


BEGIN = 1_700_000_000_000_000  # µs since 1970, when a run begins
