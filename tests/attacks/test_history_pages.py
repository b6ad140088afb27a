"""History in pages: whole, each sample once, over any link, and while others ask for it all."""

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

from gateway.parts.history.store.file import HistoryFile
from gateway.tags import good
from tests.e2e.paced_link import paced_link
from tests.e2e.processes import Program, slowed, started, write_config
from tests.history.recorded import NOON, SECOND, store_run
from tests.history_writer import tag
from tests.zenoh_peer import Reply, ZenohPeer, free_endpoint

TAGS = [tag(f"t{n}").with_origin("simulated") for n in range(20)]
RUNS, IN_RUN = 5, 400
EVERYTHING = {f"{TAGS[n % 20].key} {n}" for n in range(RUNS * IN_RUN)}


def recorded(path: Path, in_run: int = IN_RUN) -> None:
    """Five sorted runs."""
    with closing(HistoryFile(path, 10**8)) as file:
        for run in range(1, RUNS + 1):
            numbers = range((run - 1) * in_run, run * in_run)
            store_run(file, [good(TAGS[n % 20], n, NOON + n * SECOND) for n in numbers])


def config(folder: Path, endpoint: str) -> Path:
    tags = {tag.name: {"address": f"D{n}", "history": True} for n, tag in enumerate(TAGS)}
    device = {"protocol": "vigor", "station": 1, "enabled": False, "tags": tags}
    return write_config(
        folder / "c.yaml",
        endpoint,
        {"hall": {"port": "simulator", "devices": {"mixer": device}}},
        history={"path": "h.db", "keep": "3650d"},
    )


@asynccontextmanager
async def serving(folder: Path, endpoint: str) -> AsyncIterator[Program]:
    with await asyncio.to_thread(started, config(folder, endpoint)) as program:
        await asyncio.to_thread(program.says, "history ready")
        yield program


def shown(replies: list[Reply]) -> list[str]:
    """Returns the good samples: the start of the gateway is in history too."""
    return [
        f"{key.removeprefix('plant/')} {known['value']}"
        for key, known in samples(replies)
        if known.get("quality") == "good"
    ]


def samples(replies: list[Reply]) -> Iterator[tuple[str, dict[str, Any]]]:
    for reply in replies:
        if reply.key == "plant/@gateway/demo/page/samples":
            yield from zip(reply.json["keys"], reply.json["values"], strict=True)
        elif reply.key:
            yield reply.key, reply.json


async def page(client: ZenohPeer, selector: str) -> tuple[list[str], dict[str, Any]]:
    """Returns the good samples of a page and its end."""
    replies = await client.get(selector, accept_replies="ANY")
    [end] = [reply for reply in replies if reply.key == "plant/@gateway/demo/page"]
    replies.remove(end)
    assert end.json["samples"] == len([*samples(replies)])
    return shown(replies), end.json


async def pages(client: ZenohPeer, selector: str, end: dict[str, Any] | None = None) -> list[str]:
    """Reads to the end; notes it in `end`."""
    found, after = list[str](), ""
    while True:
        samples, last = await page(client, selector + after)
        found += samples
        after = f";after={last['next']}"
        if last["complete"]:
            if end is not None:
                end.update(last)
            return found


async def test_pages_have_each_sample_once_over_a_slow_link_too(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    recorded(tmp_path / "h.db")
    async with (
        serving(tmp_path, endpoint),
        paced_link(endpoint, rate=1_000_000, delay=0.1) as link,
        ZenohPeer("client", connect=[endpoint]) as near,
        ZenohPeer("client", connect=[link.endpoint]) as far,
    ):
        for client, size in ((near, 70), (near, 100_000), (far, 700)):
            end: dict[str, Any] = {}
            found = await pages(client, f"plant/**?_time=[..];page={size}", end)
            assert len(found) == len(EVERYTHING)
            assert set(found) == EVERYTHING
        rest = await page(near, f"plant/**?_time=[..];page=9;after={end['next']}")
        assert rest == ([], {**end, "samples": 0})
        one = await pages(near, "plant/mixer/t3?_time=[2026-11-21T12:10:00Z..];page=11")
        assert one == [f"mixer/t3 {n}" for n in range(603, RUNS * IN_RUN, 20)]
        assert set(shown(await near.get("plant/**?_time=[..]"))) == EVERYTHING
        current = await pages(near, "plant/**?page=7")
        assert current == []  # no value is good
        for wrong in ("page=0", "page=9;after=demo:x", "page=many"):
            [reply] = await near.get(f"plant/**?_time=[..];{wrong}", accept_replies="ANY")
            assert reply.json["error"] == "bad-query"
        [reply] = await near.get("plant/**?_time=[..];page=9")
        assert "accept_replies" in reply.json["reason"]


def damage(path: Path) -> None:
    """As a flipped bit would do it."""
    recorded(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE sample SET value = 1235 WHERE value = 1234")


async def test_damage_is_told_and_the_rest_is_answered(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "h.db"
    damage(path)
    async with (
        serving(tmp_path, endpoint) as program,
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        *samples, error = await client.get("plant/**?_time=[..]")
        assert not error.ok
        assert error.json["error"] == "damaged"
        found = set(shown(samples))
        assert found < EVERYTHING
        assert len(found) >= len(EVERYTHING) - 1
        end: dict[str, Any] = {}
        assert set(await pages(client, "plant/**?_time=[..];page=150", end)) == found
        await asyncio.to_thread(program.says, "history damaged")
        await client.get_until(
            "plant/@gateway/demo/history", lambda status: "damaged" in status["state"]
        )


async def test_a_client_that_reads_slowly_behind_large_buffers_gets_all(tmp_path: Path) -> None:
    """Without an error it would take half of the answer for the whole."""
    endpoint, many = free_endpoint(), 6000
    recorded(tmp_path / "h.db", many)
    async with (
        serving(tmp_path, endpoint),
        paced_link(endpoint, rate=2_000_000, large=True) as link,
        ZenohPeer("client", connect=[link.endpoint]) as client,
    ):
        replies = await client.get("plant/**?_time=[..]", timeout=slowed(90), consolidation="NONE")
        assert len(shown(replies)) == RUNS * many
        assert link.connections == 1


async def test_what_was_deleted_before_it_was_read_is_told(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "h.db"
    recorded(path)
    begin = "plant/@gateway/demo/page?_time=[..];page=70"
    async with serving(tmp_path, endpoint), ZenohPeer("client", connect=[endpoint]) as client:
        first, end = await page(client, begin)
        assert first == [f"{TAGS[n % 20].key} {n}" for n in range(70)]
        assert "again" not in end
    with closing(HistoryFile(path, 10**8)) as file:
        file.drop(file.closed_runs(NOON, 0)[0])
    async with serving(tmp_path, endpoint), ZenohPeer("client", connect=[endpoint]) as client:
        found, end = await page(client, f"{begin};after={end['next']}")
        assert end["damaged"] == f"{IN_RUN - 70} samples were deleted unread"
        assert found[0] == f"{TAGS[0].key} {IN_RUN}"
        found, end = await page(client, f"{begin};after={end['next']}")
        assert "damaged" not in end


async def test_a_disk_of_an_earlier_day_is_read_from_the_beginning(tmp_path: Path) -> None:
    """The file is the same one, with the same mark: its numbers are given to other samples."""
    endpoint, path = free_endpoint(), tmp_path / "h.db"
    recorded(path)
    begin = "plant/@gateway/demo/page?_time=[..];page=100000"
    async with serving(tmp_path, endpoint), ZenohPeer("client", connect=[endpoint]) as client:
        assert len((await page(client, begin))[0]) == RUNS * IN_RUN
        _, end = await page(client, begin)
    with closing(sqlite3.connect(path)) as database, database:
        for table in ("sample", "run"):
            database.execute(f"DELETE FROM {table} WHERE id > {2 * IN_RUN}")  # noqa: S608
    async with serving(tmp_path, endpoint), ZenohPeer("client", connect=[endpoint]) as client:
        found, end = await page(client, f"{begin};after={end['next']}")
        assert len(found) == 2 * IN_RUN
        assert end["damaged"] == "the file is an older copy: it is read from its beginning"
        found, end = await page(client, f"{begin};after={end['next']}")
        assert (found, "damaged" in end) == ([], False)
