"""Clients that query, page, write and leave, and check every answer."""

import asyncio
import json
import random
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from gateway.tags import Tag
from tests.sim.north_judge import BEGIN, GATEWAY, STORED, Attempt, Judge, micros
from tests.sim.north_peers import Answer, Client

PAGE = f"{GATEWAY}/page"
GROUPS = "north-groups"  # a pace: the writer also writes several tags at once
PATIENCE = 30.0  # seconds for an answer
ERRORS = {"busy", "bad-query", "damaged", "unclear"}


@dataclass(eq=False)
class Person:
    """A client program, and what it knows. `rarity`: seconds between its requests."""

    client: Client
    judge: Judge
    tags: Sequence[Tag]
    current: Callable[[Tag], Any]  # the sample that the gateway has now
    chance: random.Random
    rarity: float

    def __post_init__(self) -> None:
        self._values = 0

    async def _pause(self) -> None:
        await asyncio.sleep(self.chance.expovariate(1 / self.rarity))

    def _undisturbed(self, answer: Answer, links: int) -> bool:
        """The client got all that was sent: no error, and no link has changed."""
        for error in answer.errors:
            if error not in ERRORS:
                self.judge.broke(f"an answer ends with {error}")
        at = self.client.at
        changed = at is not None and (not at.link.is_up or at.link.since >= answer.asked)
        count = self.judge.story.counts
        count["answers"] += 1
        count[f"answers: {answer.errors[0] if answer.errors else answer.ended}"] += 1
        whole = answer.ended == "whole" and not answer.errors
        return whole and links == self.client.links and not changed

    # Queries

    async def ask_now_and_then(self) -> None:
        kinds = [self.all_now, self.one_now, self.pages_now, self.past, self.past_in_pages]
        while True:
            await self._pause()
            await self.chance.choice(kinds)()

    async def _ask(self, selector: str, **about: Any) -> tuple[Answer, bool, float]:
        """Returns the answer, whether it must be whole, and when its query arrived."""
        arrived = [float("inf")]

        def note() -> None:
            arrived[0] = self.judge.now

        links = self.client.links
        answer = await self.client.get(selector, PATIENCE, arrived=note, **about)
        return answer, self._undisturbed(answer, links), arrived[0]

    async def all_now(self) -> bool:
        answer, whole, _ = await self._ask("plant/**")
        if whole:
            self._each_once([key for key, _ in answer.values])
        return whole

    async def one_now(self) -> bool:
        tag = self.chance.choice(self.tags)
        since = self.current(tag).time // 1000
        answer, whole, _ = await self._ask(f"plant/{tag.key}")
        if whole:
            times = [micros(value["time"]) for _, value in answer.values]
            if len(times) != 1 or times[0] < since:
                self.judge.broke(f"{tag.key}: {times} instead of one value since {since}")
        return whole

    async def pages_now(self) -> bool:
        found, after, size = list[str](), "", self.chance.choice((3, 10, 50))
        while True:
            selector = f"plant/**?page={size}{after}"
            answer, whole, _ = await self._ask(selector, any_key=True)
            end, values = self._page(answer)
            if end is None:
                self._must_have_end(selector, whole=whole)
                return False
            found += [key for key, _ in values]
            if end["complete"]:
                self._each_once(found)
                return True
            after = f";after={end['next']}"

    def _each_once(self, keys: list[str]) -> None:
        if sorted(keys) != sorted(f"plant/{tag.key}" for tag in self.tags):
            self.judge.broke(f"an answer has {len(keys)} values of {len(self.tags)} tags, no error")

    def _page(self, answer: Answer) -> tuple[Any, list[tuple[str, Any]]]:
        """Returns the end and the values of a page; None if values are missing."""
        ends = [value for key, value in answer.values if key == PAGE]
        values = [(key, value) for key, value in answer.values if key != PAGE]
        if len(ends) != 1 or ends[0]["samples"] != len(values):
            self.judge.story.counts["pages with losses"] += 1
            return None, []
        self.judge.story.counts["pages"] += 1
        return ends[0], values

    def _must_have_end(self, selector: str, *, whole: bool) -> None:
        if whole:
            self.judge.broke(f"{selector} has no right end, without an error")

    # The past

    async def past(self) -> bool:
        since = max(self.judge.began, self.judge.now - self.chance.choice((5.0, 60.0, 600.0)))
        kept = [tag for tag in self.tags if tag.publishing.history]
        tag = self.chance.choice([None, *kept])
        place = "**" if tag is None else tag.key
        answer, whole, arrived = await self._ask(f"plant/{place}?_time=[{self._text(since)}..]")
        if whole:
            found = [_sample(*value) for value in answer.values]
            self.judge.story.counts["samples of the past"] += len(found)
            if tag is None:
                self._all_of(found, since, arrived)
            self._no_doubles(found)
        return whole

    async def past_in_pages(self) -> bool:
        """Pages until the last one, each again until it is whole."""
        since = max(self.judge.began, self.judge.now - self.chance.choice((20.0, 300.0, 3600.0)))
        after, size = "", self.chance.choice((20, 100, 1000))
        found: list[tuple[str, int, Any]] = []
        saved: list[tuple[str, int, Any]] = []
        until = self.judge.now + 20 * self.rarity
        while self.judge.now < until:
            selector = f"plant/**?_time=[{self._text(since)}..];page={size}{after}"
            answer, whole, arrived = await self._ask(selector, any_key=True)
            end, values = self._page(answer)
            if end is None:
                self._must_have_end(selector, whole=whole)
                await asyncio.sleep(0.5)
                continue
            samples = [_sample(*value) for value in values]
            found += samples
            stored = (arrived - STORED - self.judge.began) * 1e6 + BEGIN
            saved += [sample for sample in samples if sample[1] < stored]
            if end["complete"]:
                self.judge.story.counts["samples in pages"] += len(found)
                self._all_of(found, since, arrived)
                self._no_doubles(saved)
                return True
            after = f";after={end['next']}"
        return False

    def _all_of(self, found: Sequence[tuple[str, int, Any]], since: float, arrived: float) -> None:
        if lack := self.judge.missing(found, since, arrived):
            self.judge.broke(lack)

    def _no_doubles(self, found: Sequence[tuple[str, int, Any]]) -> None:
        recorded = {(tag, time, value): 0 for _, tag, time, value in self.judge.recorded}
        for _, tag, time, value in self.judge.recorded:
            recorded[tag, time, value] += 1
        for sample in found:
            left = recorded.get(sample, 0)
            if not left:
                self.judge.broke(f"{sample} is in the answer more often than it was recorded")
                return
            recorded[sample] = left - 1

    def _text(self, at: float) -> str:
        return _text(at - self.judge.began)

    async def outcomes(self) -> list[Any] | None:
        answer, whole, _ = await self._ask(f"{GATEWAY}/writes?_time=[..]")
        return [value for _, value in answer.values] if whole else None

    # Writes

    async def write_now_and_then(self) -> None:
        writable = [tag for tag in self.tags if tag.write is not None]
        async with asyncio.TaskGroup() as tasks:
            while True:
                await self._pause()
                if self.judge.story.pace == GROUPS:
                    tasks.create_task(self._write_group(self.chance.choice(writable).device))
                burst = self.chance.choice((1, 1, 1, 2, 12, 60))
                for _ in range(burst):
                    tasks.create_task(self._write(self.chance.choice(writable)))

    def _write(self, tag: Tag) -> Coroutine[None, None, None]:
        dated, by_put = self.chance.random() < 0.3, self.chance.random() < 0.2
        made = self.judge.now if dated else None
        return self._send(self._attempt(tag, made, by_put))

    def _attempt(self, tag: Tag, made: float | None, by_put: bool) -> Attempt:
        self._values += 1
        attempt = Attempt(tag.key, self._values % 60_000 + 1, made, by_put)
        self.judge.attempts[tag.key, attempt.value] = attempt
        return attempt

    async def _write_group(self, device: str) -> None:
        """Writes the tags of a device that can be written, in any order, by query or by put."""
        tags = [tag for tag in self.tags if tag.device == device and tag.write is not None]
        self.chance.shuffle(tags)
        by_put = self.chance.random() < 0.2
        group = {tag.name: self._attempt(tag, None, by_put) for tag in tags}

        def arrived() -> None:
            for attempt in group.values():
                attempt.arrived = self.judge.now

        key = f"plant/{device}/@set"
        payload = json.dumps({name: attempt.value for name, attempt in group.items()}).encode()
        self.judge.story.counts["groups"] += 1
        if by_put:
            self.client.put(key, payload, arrived, None)
            return
        answer = await self.client.get(key, 10.0, payload=payload, arrived=arrived)
        documents = [*answer.failures, *(document for _, document in answer.values)]
        if not documents:
            self.judge.story.counts["told nothing"] += 1
            return
        [document] = documents
        ends = document.get("tags", dict.fromkeys(group, document))
        for name, attempt in group.items():
            self.judge.told(attempt, ends[name].get("error", "written"))
        self.judge.in_order([*group.values()], done="error" not in document)

    async def _send(self, attempt: Attempt) -> None:
        def arrived() -> None:
            attempt.arrived = self.judge.now

        key, payload = f"plant/{attempt.tag}/@set", str(attempt.value).encode()
        attachment = None
        if attempt.made is not None:
            attachment = json.dumps({"time": self._text(attempt.made)}).encode()
        if attempt.by_put:
            self.client.put(key, payload, arrived, attachment)
            return
        answer = await self.client.get(
            key, 10.0, payload=payload, attachment=attachment, arrived=arrived
        )
        if answer.errors:
            self.judge.told(attempt, answer.errors[0])
        elif answer.replies:
            self.judge.told(attempt, "written")
        else:
            self.judge.story.counts["told nothing"] += 1


def _text(seconds: float) -> str:
    at = datetime.fromtimestamp(BEGIN // 1_000_000 + seconds, UTC)
    return at.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _sample(key: str, document: Any) -> tuple[str, int, Any]:
    return key.removeprefix("plant/"), micros(document["time"]), document["value"]
