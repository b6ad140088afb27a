"""Reads scattered addresses through a list registered in the PLC, where that costs less.

A PLC keeps one list, so the planner chooses the list that saves the most wire time.
"""

from collections.abc import Collection, Sequence

from gateway.planning.area_items import Seconds
from gateway.planning.planner import Block
from gateway.protocols.capabilities import Monitor
from gateway.protocols.driver import AnyDriver, Span, Unit


def with_monitor_list(
    blocks: Sequence[Block], driver: AnyDriver, seconds: Seconds, refused: Collection[Span] = ()
) -> tuple[Block, ...]:
    """Returns the plan with the blocks that a list reads at lower cost joined into one block.

    Blocks in `refused` stay apart: one bad address would make the PLC refuse the whole list.
    """
    if not isinstance(driver, Monitor):
        return tuple(blocks)
    best: tuple[float, Block, list[Block]] | None = None
    for every in sorted({block.every for block in blocks}):
        for bits in (True, False):
            alike = [
                block
                for block in blocks
                if block.every == every
                and block.span not in refused
                and (driver.areas[block.span.area].unit is Unit.BIT) is bits
            ]
            found = _best_list(alike, driver, seconds)
            if found is not None and (best is None or found[0] > best[0]):
                best = found
    if best is None:
        return tuple(blocks)
    _, block, replaced = best
    return (*(other for other in blocks if other not in replaced), block)


def _best_list(
    blocks: Sequence[Block], driver: Monitor[object], seconds: Seconds
) -> tuple[float, Block, list[Block]] | None:
    """Returns the seconds saved per second, the list's block and the blocks it replaces."""
    replaced: list[Block] = []
    spans: tuple[Span, ...] = ()
    for block in sorted(blocks, key=lambda block: (len(block.tags), block.span)):
        more = (*spans, *dict.fromkeys(tag.span for tag in block.tags))
        if driver.monitor_cost(more) is not None:
            replaced.append(block)
            spans = more
    cost = driver.monitor_cost(spans) if len(replaced) > 1 else None
    if cost is None:
        return None
    every = replaced[0].every
    saved = (sum(seconds(block.cost) for block in replaced) - seconds(cost)) / every
    if saved <= 0:
        return None
    tags = tuple(tag for block in replaced for tag in block.tags)
    return saved, Block(spans[0], every, tags, cost, listed=spans), replaced
