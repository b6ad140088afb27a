"""History over Zenoh: queries with `_time`, and a consumer that catches up after an outage."""

import asyncio
import json
import signal
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

from gateway.config import ZenohConfig, ZenohMode
from gateway.contract import payload
from gateway.contract.interfaces import History
from gateway.contract.past.buckets import Bucket, Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import CommandResult
from gateway.northbound.answering.answers import HISTORY_LIMIT
from gateway.northbound.northbound import Northbound
from gateway.parts.history.historian import Historian
from gateway.tags import Reason, Sample, Tag, WriteResult, bad, good
from gateway.tags.recorded import Recorded, RecordedQuery
from tests.e2e.processes import Program
from tests.history.recorded import record_outcome
from tests.history_writer import WEEK, until
from tests.northbound.plant import PlainDevice, PlainPlant, northbound_of, tag
from tests.test_docs import bare, table
from tests.zenoh_peer import TIMEOUT, ZenohPeer, free_endpoint

T = TypeVar("T")
EXAMPLE = Path(__file__).parents[2] / "examples" / "catch_up.py"
SPEED = tag("mixer", "speed", history=True)
DOOR = tag("mixer", "door", history=True)
OTHER = tag("mixer", "other")
SECOND = 10**9
MIDNIGHT = time.strftime("%Y-%m-%dT00:00:00Z", time.gmtime())
PAST = 1_795_262_400 * SECOND  # 2026-11-21T12:00:00Z


def plant() -> PlainPlant:
    return PlainPlant(PlainDevice("mixer", (SPEED, DOOR, OTHER)))


@asynccontextmanager
async def recording(path: Path) -> AsyncIterator[Historian]:
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    try:
        await asyncio.to_thread(until, historian, state="ok")
        yield historian
    finally:
        assert await asyncio.to_thread(historian.close)


@asynccontextmanager
async def serving(
    below: PlainPlant, historian: History, endpoint: str, *, listen: bool = False
) -> AsyncIterator[Northbound]:
    settings = ZenohConfig(
        mode=ZenohMode.PEER,
        listen=(endpoint,) if listen else (),
        connect=() if listen else (endpoint,),
    )
    northbound = northbound_of(below, settings, history=historian)
    serves = asyncio.create_task(northbound.run())
    try:
        async with asyncio.timeout(300):
            await northbound.opened.wait()
        yield northbound
    finally:
        serves.cancel()
        await asyncio.wait([serves], timeout=TIMEOUT)


async def test_history_is_answered_by_zenohs_time_ranges(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        recording(tmp_path / "h.db") as historian,
        serving(plant(), historian, endpoint, listen=True),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        historian.record(good(SPEED, n, PAST + n * SECOND) for n in range(1000))
        historian.record([bad(DOOR, Reason.NO_REPLY, PAST), good(DOOR, 7, PAST + SECOND)])

        async def asked(selector: str) -> list[object]:
            return [reply.json.get("value") for reply in await client.get(selector)]

        speed = "plant/mixer/speed?_time="
        assert await asked(f"{speed}[..]") == list(range(1000))
        assert await asked(f"{speed}[..]&limit=2".replace("&", ";")) == [0, 1]
        assert await asked(f"{speed}]2026-11-21T12:16:37Z..]") == [998, 999]
        assert await asked(f"{speed}[..2026-11-21T12:00:02Z[") == [0, 1]
        door = await client.get("plant/mixer/door?_time=[..]")
        assert [reply.json for reply in door] == [
            {
                "value": None,
                "quality": "bad",
                "reason": "no-reply",
                "time": "2026-11-21T12:00:00.000000Z",
            },
            {"value": 7, "quality": "good", "time": "2026-11-21T12:00:01.000000Z"},
        ]
        both = await client.get("plant/**?_time=[..2026-11-21T12:00:00Z]")
        assert sorted(str(reply.key) for reply in both) == ["plant/mixer/door", "plant/mixer/speed"]
        assert await asked("plant/mixer/other?_time=[..]") == []
        for wrong in ("[now(-1h);30m]", "yesterday", "[..]&limit=-1", "[..]&limit=many"):
            [reply] = await client.get(speed + wrong.replace("&", ";"))
            assert reply.json["error"] == "bad-query", wrong


class SlowHistory:
    """A history that answers only when `go` is set, and notes each range with its `now`."""

    def __init__(self) -> None:
        self.asked: dict[str, list[int]] = {}  # every `now` by range
        self.go = threading.Event()

    def samples(self, tag: Tag, time_range: str, limit: int | None, now: int) -> Iterator[Sample]:
        return self._answer(time_range, now, [good(tag, 1, PAST)])

    def buckets(
        self, tag: Tag, question: HistoryQuery, now: Now, pause: Callable[[], None]
    ) -> Iterator[Bucket]:
        raise NotImplementedError

    def newest(
        self, tag: Tag, question: HistoryQuery, now: int, pause: Callable[[], None]
    ) -> Iterator[Sample]:
        return self._answer(question.time_range, now, [good(tag, 1, PAST)])

    def as_recorded(self, query: RecordedQuery, pause: Callable[[], None]) -> Recorded:
        return self._answer(query.time_range, query.now, [(True, ("0", 0, 0))])

    def writes(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        return self._answer(time_range, now, ["{}"])

    def alarms(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        raise NotImplementedError

    def record_alarm(self, time: int, change: str) -> None:
        raise NotImplementedError

    def record_write(self, time: int, outcome: str, *, refused: bool) -> None:
        raise NotImplementedError

    def _answer(self, time_range: str, now: int, found: list[T]) -> Iterator[T]:
        self.asked.setdefault(time_range, []).append(now)
        assert self.go.wait(300)
        return iter(found)


async def test_now_is_the_time_at_which_the_query_arrived_for_all_its_tags() -> None:
    endpoint, slow = free_endpoint(), SlowHistory()
    async with (
        serving(plant(), slow, endpoint, listen=True) as northbound,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        begun, queries = time.time_ns(), northbound.counters()["queries"]
        values = [f"plant/mixer/*?_time=[now(-{n}s)..]" for n in range(1, 6)]
        selectors = [*values, "plant/@gateway/demo/writes?_time=[now(-9s)..]"]
        answers = asyncio.create_task(client.many([(selector, None) for selector in selectors]))
        while northbound.counters()["queries"] < queries + len(selectors) and not answers.done():
            await asyncio.sleep(0.01)
        taken = time.time_ns()
        slow.go.set()
        await answers
    assert [len(nows) for nows in slow.asked.values()] == [1] * len(selectors)
    for nows in slow.asked.values():
        assert begun <= nows[0] <= taken
        assert set(nows) == {nows[0]}


async def test_current_values_are_answered_while_all_threads_of_history_wait() -> None:
    endpoint, slow = free_endpoint(), SlowHistory()
    async with (
        serving(plant(), slow, endpoint, listen=True) as northbound,
        ZenohPeer("client", connect=[endpoint]) as historian,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        count = HISTORY_LIMIT + 2
        queries = northbound.counters()["queries"] + count
        answers = asyncio.create_task(
            historian.many([(f"plant/**?_time=[now(-{n}s)..]", None) for n in range(count)])
        )
        while northbound.counters()["queries"] < queries and not answers.done():
            await asyncio.sleep(0.01)
        assert len(await client.get("plant/**")) == 3
        assert len(await client.get("plant/mixer/speed")) == 1
        slow.go.set()
        ends = [[reply.json["error"] for reply in replies] for replies in await answers]
    assert sorted(ends) == [[]] * HISTORY_LIMIT + [["busy"]] * 2


async def test_the_queries_that_the_page_shows_are_answered(tmp_path: Path) -> None:
    endpoint, now, ever = free_endpoint(), time.time_ns(), 2**63
    minute, noon = 60 * SECOND, PAST - 86400 * SECOND  # 2026-11-20T12:00:00Z
    shown = noon + 123_456_000
    first_and_last = {
        "[now(-1h)..]": (now - 60 * minute, ever),
        "[2026-11-20T12:00:00Z..2026-11-20T13:00:00Z[": (noon, noon + 60 * minute - 1),
        "[now(-10m)..now(-5m)]": (now - 10 * minute, now - 5 * minute),
        "]2026-11-20T12:00:00.123456Z..];limit=1000": (shown + 1, ever),
        "[..]": (0, ever),
    }
    selectors = [bare(row[0]) for row in table("history.md", "Asking", "selector")]
    kept = {noon - minute: 1, shown: 2, shown + 1000: 3, now - 7 * minute: 4, now - minute: 5}
    async with (
        recording(tmp_path / "h.db") as historian,
        serving(plant(), historian, endpoint, listen=True),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        historian.record(good(SPEED, value, at) for at, value in kept.items())
        answers = {selector: await client.get(selector) for selector in selectors}
    assert {
        selector.partition("_time=")[2]: [reply.json.get("value") for reply in replies]
        for selector, replies in answers.items()
    } == {
        asked: [kept[at] for at in sorted(kept) if first <= at <= last]
        for asked, (first, last) in first_and_last.items()
    }


async def test_outcomes_of_writes_and_commands_are_queried_by_time(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    writes = "plant/@gateway/demo/writes"
    done = [
        WriteOutcome("plant/mixer/speed", 7, WriteResult(7, PAST, 0.1), PAST, 0.1, "alice"),
        WriteOutcome(
            "plant/mixer/@stop", None, CommandResult("ok", PAST, 0.2), PAST + 1, 0.2, command=True
        ),
        WriteOutcome("plant/mixer/speed", 8, Failure(Problem.UNCLEAR, "?"), PAST + SECOND, 8.0),
    ]
    async with (
        recording(tmp_path / "h.db") as historian,
        serving(plant(), historian, endpoint, listen=True),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        for outcome in done:
            record_outcome(historian, outcome)
        async with asyncio.timeout(300):
            while historian.document()["writes_stored"] != len(done):
                await asyncio.sleep(0.01)

        async def asked(selector: str) -> list[Any]:
            return [reply.json for reply in await client.get(f"{writes}?_time={selector}")]

        lines = await asked("[..]")
        assert lines == [json.loads(payload.write_outcome(outcome)) for outcome in done]
        assert [line["outcome"] for line in lines] == ["written", "obeyed", "unclear"]
        assert await asked("[..];limit=1") == lines[:1]
        assert await asked("[2026-11-21T12:00:01Z..]") == lines[2:]
        assert [line["error"] for line in await asked("yesterday")] == ["bad-query"]


class Poll:
    """Records and publishes 1, 2, 3 ... every 5 ms, independently of the network."""

    def __init__(self, historian: Historian) -> None:
        self.plant = plant()
        self.count = 0
        self.northbound: Northbound | None = None
        self._historian = historian

    async def run(self) -> None:
        while True:
            self.count += 1
            sample = self.plant.now("mixer/speed", self.count)
            self._historian.record([sample])
            if (northbound := self.northbound) is not None:
                before = northbound.counters()["published"]
                northbound.publish([sample])
                # Waits for the put: on a busy machine a newer sample would supersede it.
                while (
                    self.northbound is northbound and northbound.counters()["published"] <= before
                ):
                    await asyncio.sleep(0.005)
            await asyncio.sleep(0.005)

    @asynccontextmanager
    async def on_air(self, endpoint: str) -> AsyncIterator[None]:
        async with serving(self.plant, self._historian, endpoint) as self.northbound:
            yield
            self.northbound = None


class Consumer:
    """The example in another process, and the lines it prints."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.lines: list[str] = []
        self._process = process
        self._arrived = asyncio.Event()
        self._listening = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.lines.append(line.decode().strip())
            self._arrived.set()

    async def knows(self, value: int) -> None:
        async with asyncio.timeout(300):
            while not any(line.endswith(f"speed {value}") for line in self.lines[-500:]):
                self._arrived.clear()
                await self._arrived.wait()

    async def end(self) -> None:
        self._process.kill()
        await asyncio.gather(self._process.wait(), self._listening)


# The example with short pages: a check takes many of them, while new samples arrive.
SHORT_PAGES = """
import runpy, sys
example = runpy.run_path(sys.argv.pop(1))
example["main"].__globals__.update(FIRST_PAGE=20, PAGE=20)
example["main"]()
"""


@asynccontextmanager
async def consuming(endpoint: str, since: str, *program: str) -> AsyncIterator[Consumer]:
    """Kills the consumer at the end. `program`: the arguments of Python that run the example."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *(program or [str(EXAMPLE)]),
        *("--connect", endpoint, "--since", since),
        stdout=asyncio.subprocess.PIPE,
    )
    consumer = Consumer(process)
    try:
        yield consumer
    finally:
        await consumer.end()


@asynccontextmanager
async def polling(path: Path) -> AsyncIterator[Poll]:
    async with recording(path) as historian:
        poll = Poll(historian)
        goes_on = asyncio.create_task(poll.run())
        try:
            yield poll
        finally:
            goes_on.cancel()


@asynccontextmanager
async def polling_and_consuming(path: Path, endpoint: str) -> AsyncIterator[tuple[Poll, Consumer]]:
    async with polling(path) as poll, consuming(endpoint, MIDNIGHT) as consumer:
        yield poll, consumer


def nothing_lost_and_nothing_twice(lines: list[str]) -> None:
    speeds = [line.split() for line in lines if "plant/mixer/speed" in line]
    assert [int(words[2]) for words in speeds] == list(range(1, len(speeds) + 1))
    assert not any("late" in words for words in speeds)


async def test_ctrl_c_ends_the_consumer_without_output(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    command = (sys.executable, EXAMPLE, "--connect", endpoint)
    with Program(*command) as waiting:
        waiting.says("waiting for")
        assert waiting.end(signal.SIGINT) == 0
        assert not waiting.has_said("Traceback")
    async with (
        polling(tmp_path / "h.db") as poll,
        ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]),
        poll.on_air(endpoint),
    ):
        with Program(*command, "--since", MIDNIGHT) as consumer:
            await asyncio.to_thread(consumer.says, "speed 1")
            assert await asyncio.to_thread(consumer.end, signal.SIGINT) == 0
            assert not consumer.has_said("Traceback")


async def test_a_consumer_loses_nothing_when_its_router_is_killed(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with polling_and_consuming(tmp_path / "h.db", endpoint) as (poll, consumer):
        async with poll.on_air(endpoint):
            for _ in range(3):
                async with ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]) as router:
                    await consumer.knows(poll.count + 50)
                    await router.kill()
                missed = poll.count + 50
                while poll.count < missed:
                    await asyncio.sleep(0.01)
            async with ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]):
                await consumer.knows(poll.count + 50)
        nothing_lost_and_nothing_twice(consumer.lines)


async def test_a_sample_that_arrives_during_a_long_check_is_delivered_once(tmp_path: Path) -> None:
    """It is in a page too, and not in the last one."""
    endpoint = free_endpoint()
    async with (
        ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]),
        polling(tmp_path / "h.db") as poll,
        poll.on_air(endpoint),
    ):
        while poll.count < 150:
            await asyncio.sleep(0.01)
        async with consuming(endpoint, MIDNIGHT, "-c", SHORT_PAGES, str(EXAMPLE)) as consumer:
            await consumer.knows(poll.count)
            await consumer.knows(poll.count + 100)
        nothing_lost_and_nothing_twice(consumer.lines)


async def test_a_consumer_loses_nothing_while_the_gateway_is_down(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]),
        polling_and_consuming(tmp_path / "h.db", endpoint) as (poll, consumer),
    ):
        for _ in range(2):
            async with poll.on_air(endpoint):
                await consumer.knows(poll.count + 50)
        nothing_lost_and_nothing_twice(consumer.lines)


async def test_a_killed_consumer_continues_from_its_last_sample(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    known: list[str] = []
    async with (
        ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]),
        polling(tmp_path / "h.db") as poll,
        poll.on_air(endpoint),
    ):
        for _ in range(4):
            since = known[-1].split()[0] if known else MIDNIGHT
            async with consuming(endpoint, since) as consumer:
                await consumer.knows(poll.count + 50)
            # The second query of a consumer returns its last sample again.
            whole = [line for line in consumer.lines if line.split()[0] > since or not known]
            known += [line for line in whole if "plant/mixer/speed" in line]
        assert poll.northbound is not None
        async with ZenohPeer("client", connect=[endpoint]) as client:
            assert len(await client.get("plant/**")) == 3  # and it answers as before
            await client.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
    nothing_lost_and_nothing_twice(known)
