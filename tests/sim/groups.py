"""Clients that write several tags of a device at once, and check every outcome."""

import random
from collections.abc import Sequence

from gateway.errors import GatewayError, NotSent
from gateway.tags import Tag, WriteResult
from gateway.values import Kind, Value
from tests.sim.arrays import shown, value_of
from tests.sim.clients import NOT_SENT, Asked, Client
from tests.sim.hostile import DELAYING
from tests.sim.obeyed import all_times, counts, most_requests, times, written_by_clients


async def write_group(chance: random.Random, client: Client, few: list[tuple[Tag, Value]]) -> None:
    """Writes tags in their order. After the first that is not done none may arrive."""
    device, judge, bus = client.device, client.judge, client.bus
    tags = written_by_clients(device.tags)
    writes, station = _larger(few, tags, chance), judge.stations[device.name]
    mark, since = client.mark(), judge.now
    known = [counts(station, tag) for tag, _ in writes]
    held = [shown(tag, station.holds(tag)) for tag, _ in writes]
    ends: Sequence[WriteResult | GatewayError]
    try:
        ends = await judge.gateway.write_group(writes, 5.0, 60.0)
    except GatewayError as error:
        ends = [error] * len(writes)
    sent = client.sent(mark)
    bus.note("group", device.name, [type(end).__name__ for end in ends], sent)
    judge.story.counts["groups"] += 1
    judge.story.counts["groups done"] += all(isinstance(end, WriteResult) for end in ends)
    judge.story.counts["tags of groups"] += len(writes)
    judge.story.counts["writes of groups"] += sent
    most = sum(most_requests(tag) for tag, _ in writes)
    if sent > most + len(writes) // 2:
        judge.broke(f"{device.name}: {len(writes)} tags were sent {sent} times")
    stopped = ""  # the first tag that was not sent for another
    came, last = 0.0, ""
    for (tag, value), end, before, was in zip(writes, ends, known, held, strict=True):
        if stopped and not isinstance(end, NOT_SENT):
            judge.broke(f"{tag.key} ended {end!r} after {stopped} was not sent")
        if isinstance(end, NotSent):
            stopped = stopped or tag.key
        words = [other.span for other, _ in writes]
        if words.count(tag.span) > 1:
            continue  # bits of one word: the PLC gets them together
        obeyed = times(station, tag, before)
        await client.judge_end(tag, value, end, Asked(since, sent, True, was), obeyed)
        if obeyed and bus.hurt_at < since and not client.deaf(tag.device, since, DELAYING):
            at = min(at for at in all_times(station, tag) if at >= since)
            if at < came:
                judge.broke(f"{tag.key} was written before {last}")
            came, last = at, tag.key


def _larger(
    writes: list[tuple[Tag, Value]], tags: Sequence[Tag], chance: random.Random
) -> list[tuple[Tag, Value]]:
    """Adds tags: some in the order of their addresses, or all of the device."""
    others = [tag for tag in tags if tag not in [known for known, _ in writes]]
    more = chance.sample(others, chance.choice((0, min(5, len(others)), len(others))))
    group = [*writes, *((tag, _value(tag, chance)) for tag in more)]
    return sorted(group, key=lambda one: one[0].span) if chance.random() < 0.5 else group


def _value(tag: Tag, chance: random.Random) -> Value:
    if tag.layout.type.count:
        numbers = [chance.randrange(1 << 16) for _ in range(tag.span.size)]
        return value_of(tag, numbers[0])
    if tag.layout.type.kind is Kind.BOOL:
        return chance.random() < 0.5
    return chance.randrange(1 << 16 * tag.span.size)
