"""Runs: neighbouring addresses that several writes of one group fill, so that one request has all.

Parts of words are put into their word, which is read just before. So a run holds only words that
are written, and no address between them.
"""

from collections.abc import Sequence

from gateway.engine.device.long_writes import writes_around
from gateway.engine.jobs.requests import Write
from gateway.protocols.driver import Span
from gateway.tags import Tag

_WHOLE = -1  # all bits of an address


def run_of(writes: Sequence[Write]) -> tuple[int, Span]:
    """Returns how many of the first writes fill one run that one request writes, and the run.

    Their order does not count inside a run: the device gets them all at once. A tag with `repeat`
    has a request of its own, because it may be sent twice. So has a known bad address: the device
    would refuse the others with it.
    """
    device, (area, first, size) = writes[0].device, writes[0].tag.span
    driver, end = device.driver, first + size
    count, run = 1, writes[0].tag.span
    written: dict[int, int] = {}  # the bits of each address
    reads = False
    for number, write in enumerate(writes, 1):
        tag = write.tag
        if tag.span.area != area or not _may_share(write):
            break
        mask = _WHOLE if tag.part is None else tag.part.bits
        for address in range(tag.span.start, tag.span.start + tag.span.size):
            if written.get(address, 0) & mask:  # the second value would be lost, or the first
                return count, run
            written[address] = written.get(address, 0) | mask
        first, end = min(first, tag.span.start), max(end, tag.span.start + tag.span.size)
        hull = Span(area, first, end - first)
        reads = reads or tag.part is not None or verified(tag)
        if driver.write_cost(hull) is None or (reads and driver.cost(hull) is None):
            break
        if len(written) == hull.size and not writes_around(driver, hull):
            count, run = number, hull
    return count, run


def _may_share(write: Write) -> bool:
    tag, rule = write.tag, write.tag.write
    if write.refused or tag.origin.shape is not None or (rule is not None and rule.repeat):
        return False
    return not any(bad.overlaps(tag.span) for bad in write.device.bad_addresses.bad)


def verified(tag: Tag) -> bool:
    """Returns True if the tag is read back after a write."""
    return tag.write is not None and tag.write.verify


def needs_read(writes: Sequence[Write]) -> bool:
    """Returns True if the words of the run are read first, because parts of them are written."""
    return any(write.part is not None for write in writes)


def together(run: Span, writes: Sequence[Write], held: Sequence[int]) -> list[int]:
    """Returns the units of the run with all writes in it. `held`: as read; zeros without parts."""
    units = list(held)
    for write in writes:
        at, part = write.tag.span.start - run.start, write.part
        if part is None:
            units[at : at + write.tag.span.size] = write.units
        else:
            units[at] = part.into(units[at], write.units[0])
    return units


def own_units(write: Write, run: Span, held: Sequence[int]) -> Sequence[int]:
    """Returns the units of the write's tag, of those of its run."""
    at = write.tag.span.start - run.start
    return held[at : at + write.tag.span.size]
