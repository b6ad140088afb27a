"""Clients behind slow links get whole answers, and keep nobody else waiting."""

import asyncio
import json
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.e2e.paced_link import PacedLink, paced_link
from tests.e2e.processes import (
    Program,
    gateway,
    plc_gateway,
    slowed,
    started,
    station,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import Reply, ZenohPeer, free_endpoint

COUNT = 260
TAGS = {
    "count": {"address": "D10", "every": "50ms"},
    **{f"t{n}": {"address": f"D{1000 + n}", "every": "1h"} for n in range(COUNT - 1)},
}


@asynccontextmanager
async def plant(folder: Path, endpoint: str) -> AsyncIterator[tuple[Program, ZenohPeer]]:
    """A gateway, and a client beside it without a slow link."""
    tty = folder / "tty"
    file = write_config(folder / "c.yaml", endpoint, {"hall": vigor_line(str(tty), TAGS)})
    with station("pty", str(tty)) as plc:
        plc.tell("count 1 D 10")
        with started(file) as program:
            async with ZenohPeer("client", connect=[endpoint]) as beside:
                await beside.until_alive(
                    "plant/@gateway/*/alive/*", ["plant/@gateway/demo/alive/mixer"]
                )
                while not all(
                    reply.json["quality"] == "good" for reply in await beside.get("plant/mixer/*")
                ):
                    await asyncio.sleep(0.05)  # until each block was read once
                yield program, beside


async def everything(client: ZenohPeer) -> list[Reply]:
    return await client.get("plant/**", timeout=slowed(25), consolidation="NONE")


@asynccontextmanager
async def asking(slow: ZenohPeer, link: PacedLink) -> AsyncIterator[asyncio.Task[Any]]:
    """Long answers are on their way over the link."""
    answers = asyncio.create_task(slow.many([("plant/**", None)] * 16, slowed(25)))
    try:
        async with asyncio.timeout(300):
            while not link.is_busy:
                await asyncio.sleep(0.01)
        yield answers
    finally:
        await slow.kill()
        await asyncio.gather(answers, return_exceptions=True)


async def test_answers_over_slow_links_are_whole(tmp_path: Path) -> None:
    endpoint = free_endpoint()

    async def asked(link: PacedLink) -> list[Reply]:
        async with ZenohPeer("client", connect=[link.endpoint]) as client:
            return await everything(client)

    async with (
        plant(tmp_path, endpoint),
        paced_link(endpoint, rate=64_000) as radio,
        paced_link(endpoint, rate=1_000_000, delay=0.3) as satellite,
        paced_link(endpoint, rate=4_000_000, delay=0.05, loss=0.05) as lossy,
    ):
        links = radio, satellite, lossy
        for link, replies in zip(links, await asyncio.gather(*map(asked, links)), strict=True):
            assert {reply.key for reply in replies} == {f"plant/mixer/{tag}" for tag in TAGS}
            assert link.connections == 1  # the link was not closed meanwhile


# The command itself; the longest wait for a page is shorter, so that the test is.
READ = """
import sys
import gateway.cli.client.client as client
import gateway.cli.client.value_pages as pages
client.REPLY_TIMEOUT, pages.PAGE_WITHIN = float(sys.argv.pop(1)), float(sys.argv.pop(1))
from gateway.cli.main import main
main()
"""


async def test_our_own_client_reads_more_than_arrives_in_the_time_of_one_query(
    tmp_path: Path,
) -> None:
    """10,000 values at 64 kbit/s take minutes; here it is seconds."""
    endpoint = free_endpoint()
    async with (
        plant(tmp_path, endpoint),
        paced_link(endpoint, rate=64_000) as radio,
    ):
        lines = {"hall": vigor_line("simulator", TAGS)}
        times = slowed(3.5), slowed(1.0)
        far = write_config(tmp_path / "far.yaml", radio.endpoint, lines)
        with Program(sys.executable, "-c", READ, *times, "read", far, "--json") as read:
            assert await asyncio.to_thread(read.ended) == 0
            rows = [json.loads(line) for line in read.lines]
            assert {row["tag"] for row in rows} == {f"mixer/{tag}" for tag in TAGS}
            assert all(row["quality"] == "good" for row in rows)


async def test_an_answer_over_a_slow_link_delays_nobody(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        plant(tmp_path, endpoint) as (_, beside),
        paced_link(endpoint, rate=64_000) as radio,
        ZenohPeer("client", connect=[radio.endpoint]) as slow,
    ):
        await slow.subscribe("plant/**")
        heard = await beside.subscribe("plant/mixer/count")
        async with asking(slow, radio) as answers:
            heard.forget()
            for _ in range(5):
                assert len(await everything(beside)) == COUNT
                assert len(await beside.get("plant/mixer/t1")) == 1
            await heard.until(lambda heard: len(heard.samples) >= 5)
            assert not answers.done()


async def test_a_gateway_ends_at_once_beside_a_slow_link(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        plant(tmp_path, endpoint) as (program, _),
        paced_link(endpoint, rate=64_000) as radio,
        ZenohPeer("client", connect=[radio.endpoint]) as slow,
        asking(slow, radio),
    ):
        assert await asyncio.to_thread(program.end, signal.SIGTERM, slowed(5)) == 0


async def test_a_satellite_reaches_gateway_and_router(tmp_path: Path) -> None:
    """Its round trip takes a second: each of our own programs gave a link up after one second."""
    endpoint, router = free_endpoint(), free_endpoint()
    lines = {"hall": vigor_line("simulator", {"count": {"address": "D10"}})}
    here = write_config(tmp_path / "c.yaml", endpoint, lines)
    async with (
        paced_link(endpoint, rate=1_000_000, delay=0.5) as satellite,
        paced_link(router, rate=1_000_000, delay=0.5) as uplink,
        ZenohPeer("router", listen=[router]) as far,
    ):
        away = {"mode": "client", "listen": [], "connect": [uplink.endpoint]}
        there = write_config(tmp_path / "client.yaml", endpoint, lines, zenoh=away)
        read = write_config(tmp_path / "far.yaml", satellite.endpoint, lines)
        with await asyncio.to_thread(started, there):
            await far.get_until("plant/mixer/count", lambda known: known["quality"] == "good")
        with await asyncio.to_thread(started, here):
            connect = ("--connect", satellite.endpoint)
            with gateway("bridge", "influx", *connect) as bridge:
                await asyncio.to_thread(bridge.says, "gateway demo is there")
            done = await asyncio.to_thread(plc_gateway, "status", read, "--json")
            assert done.code == 0, done.err
