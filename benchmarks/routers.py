"""A publisher with several routers, one of which is killed: `python -m benchmarks.routers`.

Three routers are linked to each other; a client is connected to the last one. A session without a
gateway, as a client, peer or router that knows two or three of them, publishes five values a second
and has a token and a queryable. The program kills the first router, starts it again, and counts in
how many rounds the client missed values for three seconds, received values twice, did not see the
token afterwards, or asked in vain, before or after the router returned.
"""

import argparse
import asyncio
from contextlib import AsyncExitStack
from typing import NamedTuple

from tests.zenoh_peer import ZenohPeer, free_endpoint

EVERY = 0.2  # seconds


class Round(NamedTuple):
    stopped: bool  # no value arrived while the router was away
    twice: bool
    lost_token: bool
    unanswered: bool


async def play(mode: str, known: int, dead: float, back: float) -> Round:
    """`known`: the number of routers that the publisher connects to."""
    ends = [free_endpoint() for _ in range(3)]
    async with AsyncExitStack() as stack:
        start = stack.enter_async_context
        first = await start(ZenohPeer("router", [ends[0]]))
        await start(ZenohPeer("router", [ends[1]], ends[:1]))
        await start(ZenohPeer("router", [ends[2]], ends[:2]))
        client = await start(ZenohPeer("client", connect=ends[2:]))
        source = await start(ZenohPeer(mode, connect=ends[:known]))
        await source.declare_token("alive")
        asked = await source.queryable("asked")
        tokens, values = await client.liveliness("alive"), await client.subscribe("value")

        ended = asyncio.Event()

        async def publish() -> None:
            number = 0
            while not ended.is_set():
                number += 1
                await source.put("value", str(number).encode())
                await asyncio.sleep(EVERY)

        async def arrives() -> bool:
            """Asks once; whether the publisher heard it."""
            known = len(asked.samples)
            await client.get("asked")
            for _ in range(20):
                if len(asked.samples) > known:
                    return True
                await asyncio.sleep(0.05)
            return False

        publishing = asyncio.create_task(publish())
        await values.next(lambda _: True)
        await asyncio.sleep(1.0)
        before = len(values.samples)
        await first.kill()
        await asyncio.sleep(dead)
        stopped = len(values.samples) - before < dead / EVERY / 2
        heard = await arrives()
        await start(ZenohPeer("router", ends[:1], ends[1:]))
        await asyncio.sleep(back)
        heard = await arrives() and heard
        ended.set()
        await publishing
        numbers = [sample.payload for sample in values.samples]
        is_alive = tokens.samples[-1].kind == "PUT"
        twice = len(numbers) > len(set(numbers))
        return Round(stopped, twice, not is_alive, not heard)


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--modes", nargs="+", default=["client", "peer", "router"])
    parser.add_argument("--dead", type=float, default=3.0, help="seconds without the router")
    parser.add_argument("--back", type=float, default=4.0, help="seconds with it again")
    options = parser.parse_args()
    rounds = options.rounds
    print("| mode | routers | rounds | values stopped | values twice | token lost | unanswered |")
    print("|---|---|---|---|---|---|---|")
    for mode, known in ((mode, known) for mode in options.modes for known in (2, 3)):
        found = [await play(mode, known, options.dead, options.back) for _ in range(rounds)]
        counts = " | ".join(str(sum(column)) for column in zip(*found, strict=True))
        print(f"| {mode} | {known} | {rounds} | {counts} |", flush=True)


if __name__ == "__main__":
    asyncio.run(main())
