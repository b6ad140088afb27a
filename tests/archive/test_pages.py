"""Answers to the archiver that are not whole, or from another program."""

import asyncio
import json
import time
from collections.abc import Callable, Sequence
from typing import cast

import pytest
import zenoh

from gateway.archive.archiver import Follower, Pace
from gateway.archive.pages import History, Page, file_of
from gateway.archive.rows import Row
from gateway.archive.store import Cursor
from gateway.errors import GatewayError
from tests.bridges.played import answered

DEMO = "plant/@gateway/demo"
SAMPLE = {"value": 1, "quality": "good", "time": "2026-11-26T12:00:00Z"}
END = {"samples": 2, "complete": True, "next": "demo:1f.a0-1-2"}


def told(query: zenoh.Query, *documents: object) -> None:
    """Replies with samples, and with a last document on the key of the query."""
    *samples, end = documents
    batch(query, dict.fromkeys(["plant/mixer/speed"], samples))
    query.reply(f"{DEMO}/page", json.dumps(end))


def batch(query: zenoh.Query, samples: dict[str, list[object]]) -> None:
    """Replies with the samples of each key."""
    pairs = [(key, value) for key, values in samples.items() for value in values]
    keys, values = zip(*pairs, strict=True) if pairs else ((), ())
    query.reply(f"{DEMO}/page/samples", json.dumps({"keys": keys, "values": values}))


def uneven(query: zenoh.Query) -> None:
    query.reply(f"{DEMO}/page/samples", '{"keys": ["plant/mixer/speed"], "values": []}')
    told(query, END)


def refuses(query: zenoh.Query) -> None:
    query.reply_err(json.dumps({"error": "busy", "reason": "later"}))


def twice(query: zenoh.Query) -> None:
    """As two gateways do."""
    for _ in range(2):
        told(query, END)


async def asked(answer: Callable[[zenoh.Query], None]) -> Page:
    async with answered(f"{DEMO}/**", answer) as session:
        return await History(session, DEMO).page("", 10)


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda _: None, "it does not answer"),
        (refuses, "busy: later"),
        (lambda query: told(query, SAMPLE, END), "1 of 2 samples have arrived"),
        (twice, "2 gateways have this name: rename"),
        (lambda query: told(query, SAMPLE, {"samples": 1}), "its answer is none of a gateway"),
        (lambda query: told(query, [1]), "its answer is none of a gateway"),
        (uneven, "its answer is none of a gateway"),
        (
            lambda query: told(query, SAMPLE, SAMPLE, END | {"next": "demo:-0-0"}),
            "its history is not ready",
        ),
    ],
)
async def test_an_answer_that_is_not_whole_is_refused(
    answer: Callable[[zenoh.Query], None], why: str
) -> None:
    with pytest.raises(GatewayError, match=why):
        await asked(answer)


async def test_what_is_no_sample_is_counted_and_what_comes_again_is_left_out() -> None:
    page = await asked(
        lambda query: told(
            query, SAMPLE, {"no": "sample"}, SAMPLE | {"value": 2}, END | {"samples": 3, "again": 1}
        )
    )
    assert [row.value for row in page.rows] == [1.0]
    assert (page.strange, page.is_last, page.is_whole, page.file) == (1, True, False, "1f.a0")


async def test_a_key_that_no_database_takes_is_strange() -> None:
    """A NUL in it would stop the archive of its gateway for ever."""

    def answer(query: zenoh.Query) -> None:
        keys = ("plant/mixer/speed", "plant/mixer/a\0b", "plant/mixer/a\nb")
        batch(query, {key: [SAMPLE] for key in keys})
        query.reply(f"{DEMO}/page", json.dumps(END | {"samples": 3}))

    page = await asked(answer)
    assert ([row.key for row in page.rows], page.strange) == (["plant/mixer/speed"], 2)


def test_the_mark_of_a_file_is_in_a_place() -> None:
    assert [file_of(place) for place in ("", "de-mo:1f.a0-4711-12", "demo:-0-0")] == [
        "",
        "1f.a0",
        "",
    ]


@pytest.mark.parametrize("noted_in", [-3600.0, 3e7])
async def test_a_gateway_without_new_samples_is_noted_as_whole(noted_in: float) -> None:
    """Also where a clock that was ahead has noted a time of next year."""
    place, stored = "demo:1f.a0-1-2", asyncio.Event()

    class Idle(History):
        async def page(self, after: str, size: int) -> Page:
            return Page([], place, True, True, None, 0)

    async def add(rows: Sequence[Row], before: Cursor, after: Cursor) -> Cursor:
        assert abs(after.whole / 1e6 - time.time()) < 3000
        stored.set()
        return after

    cursor = Cursor(DEMO, place, whole=round((time.time() + noted_in) * 1e6), overlaps=False)
    history, pages = Idle(cast("zenoh.Session", None), DEMO), asyncio.Semaphore(1)
    task = asyncio.create_task(Follower(history, cursor, add, Pace(1.0, 10), pages).run())
    async with asyncio.timeout(300):
        await stored.wait()
    task.cancel()
