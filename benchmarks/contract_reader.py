"""A consumer that knows only the schemas reads a plant with faults: `make contract MINUTES=10`.

The PLC loses replies, refuses an address, falls silent and comes back, goes beyond the range of a
sensor; a line is dead; clients write right and wrong. The consumer gets the schemas from the
gateway, subscribes, queries, and looks at every document: each key belongs to a kind, and each
document fits it, without room for unknown fields. Printed: the documents by kind, and what is
wrong. It ends with 1 if something is.
"""

import argparse
import asyncio
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from gateway.contract.documents.catalogue import SEND
from tests.contract.faulty_plant import (
    QUERIES,
    REQUESTS,
    SUBSCRIBED,
    Plant,
    faulty_plant,
    replied,
    subscribed,
)
from tests.contract.reader import Reader
from tests.zenoh_peer import Subscription, ZenohPeer

FAULTS = (  # what the PLC is told, one after the other
    ("set 1 D 20 1500", "set 1 D 22 200"),  # an alarm, a value outside its range
    ("deaf",),
    ("hear",),
    ("set 1 D 20 100", "set 1 D 22 20"),
)


def take(reader: Reader, heard: list[Subscription]) -> None:
    """Reads the messages that arrived since the last time."""
    for subscription in heard:
        for sample in subscription.samples:
            subscribed(reader, sample)
        subscription.forget()


async def read(plant: Plant, seconds: float, every: float) -> Reader:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        [served] = await client.get("plant/@gateway/*/@describe")
        reader = Reader(served.json, "plant")
        heard = [await client.subscribe(key) for key in SUBSCRIBED]
        end, turn = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            for told in FAULTS[turn % len(FAULTS)]:
                plant.plc.tell(told)
            turn += 1
            until = time.monotonic() + every
            while time.monotonic() < until:
                answers = await client.many(REQUESTS)
                for (key, _), replies in zip(REQUESTS, answers, strict=True):
                    replied(reader, key, SEND, replies)
                for verb, selectors in QUERIES.items():
                    for selector in selectors:
                        replies = await client.get(
                            selector, consolidation="NONE", accept_replies="ANY"
                        )
                        replied(reader, selector.partition("?")[0], verb, replies)
                take(reader, heard)
                await asyncio.sleep(min(1.0, every))
    return reader


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--every", type=float, default=5.0, help="seconds from fault to fault")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, faulty_plant(Path(folder)) as plant:
        reader = asyncio.run(read(plant, given.minutes * 60, given.every))
    for name, count in sorted(reader.count.items()):
        print(f"{name}: {count}")
    total = Counter(reader.count).total()
    print(f"{total} documents of {len(reader.seen)} kinds, {len(reader.wrong)} wrong")
    for wrong in reader.wrong[:20]:
        print(wrong)
    sys.exit(bool(reader.wrong))


if __name__ == "__main__":
    main()
