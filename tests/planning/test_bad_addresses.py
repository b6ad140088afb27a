"""Halving finds any set of refused addresses, and merges the others again."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.engine.device.device import Device
from gateway.planning.bad_addresses import RETRIES, SILENT, SPLIT_FIRST, KnownBad
from gateway.planning.planner import Block
from gateway.protocols.driver import Span
from tests.sim.plant import device, make_tag


class Asker:
    """Polls a device's blocks as the engine does, and counts the exchanges."""

    def __init__(self, device: Device, missing: set[int]) -> None:
        self.device = device
        self.missing = missing
        self.exchanges = 0

    def there(self, block: Block) -> bool:
        start, size = block.span.start, block.span.size
        return not any(start <= n < start + size for n in self.missing)

    def plan(self) -> None:
        self.device.plan_changes()
        assert not self.device.bad_addresses.changed

    def ask(self, block: Block) -> bool:
        """True when the device was planned again."""
        refusals = self.device.bad_addresses
        self.exchanges += 1
        if self.there(block):
            again = refusals.read(block)
            if again:
                refusals.abandon()
            if again or refusals.settle(0.0):
                self.plan()
                return True
            return False
        halves = refusals.refused(block, 7, "28")
        if any(self.ask(half) for half in halves):
            return True
        if not halves and refusals.settle(0.0):
            self.plan()
            return True
        return False

    def settle(self) -> None:
        """Polls all blocks in rounds, until a round brings nothing new."""
        for _ in range(200):
            blocks = self.device.blocks
            for block in blocks:
                if block.span not in self.device.bad_addresses.bad and self.ask(block):
                    break
            else:
                if not self.device.bad_addresses.searching:
                    return
        raise AssertionError("the search does not end")


def words(*numbers: int) -> Device:
    return device([make_tag(f"D{n}") for n in numbers])


def bad_numbers(found: Device) -> set[int]:
    return {span.start for span in found.bad_addresses.bad}


@settings(max_examples=200)
@given(st.sets(st.integers(0, 63), min_size=1), st.sets(st.integers(0, 63), max_size=6))
def test_any_set_of_bad_addresses_is_found(numbers: set[int], missing: set[int]) -> None:
    """Bad tags are named, holes in gaps are planned around, all other tags are read."""
    found = words(*sorted(numbers))
    asker = Asker(found, missing)
    asker.settle()
    assert bad_numbers(found) == numbers & missing
    for block in found.blocks:
        assert asker.there(block) or block.span in found.bad_addresses.bad
    assert {tag for b in found.blocks for tag in b.tags} == set(found.tags)


@settings(max_examples=100)
@given(st.sets(st.integers(0, 63), max_size=5))
def test_neighbours_of_bad_addresses_stay_in_one_block(missing: set[int]) -> None:
    """With every address in use: one block for each run between two culprits, no more."""
    found = words(*range(64))
    Asker(found, missing).settle()
    runs = "".join(" " if n in missing else "x" for n in range(64)).split()
    good = [block for block in found.blocks if block.span not in found.bad_addresses.bad]
    assert [block.span.size for block in good] == [len(run) for run in runs]


@settings(max_examples=100)
@given(st.sets(st.integers(0, 63), min_size=1, max_size=6))
def test_the_search_takes_about_two_log_n_transactions_for_each_bad_address(
    missing: set[int],
) -> None:
    found = words(*range(64))
    asker = Asker(found, missing)
    (whole,) = found.blocks
    asker.ask(whole)
    assert asker.exchanges <= 1 + 2 * len(missing) * math.ceil(math.log2(64))


@settings(max_examples=100)
@given(
    st.sets(st.integers(0, 40), min_size=1, max_size=6),
    st.lists(st.integers(0, 40), min_size=1, max_size=6),
)
def test_an_address_that_works_again_rejoins_its_block(
    missing: set[int], returns: list[int]
) -> None:
    found = words(*range(41))
    asker = Asker(found, missing)
    asker.settle()
    for number in returns:
        asker.missing.discard(number)
        for block in found.blocks:
            if block.span in found.bad_addresses.bad and asker.ask(block):
                break
        asker.settle()
        assert bad_numbers(found) == asker.missing
        assert not found.bad_addresses.searching
    asker.missing.clear()
    for _ in range(41):
        asker.settle()
        for block in found.blocks:
            if block.span in found.bad_addresses.bad and asker.ask(block):
                break
    assert [block.span.size for block in found.blocks] == [41]


def test_splits_found_after_a_new_try_of_the_whole_block_are_kept_until_the_next() -> None:
    """They were dropped with the next good read, and a silent device was searched for ever."""
    found = words(*range(16))
    (whole,), bad = found.blocks, found.bad_addresses

    def search() -> None:
        bad.went_silent(whole)
        for half in bad.refused(whole, 0, SILENT):
            bad.read(half)

    search()
    assert not bad.rejoin(0.0)
    assert bad.rejoin(SPLIT_FIRST)
    search()
    assert not bad.rejoin(SPLIT_FIRST + 1.0)
    assert not bad.rejoin(SPLIT_FIRST + 2.0)
    assert bad.cuts == {("D", 8)}


def test_an_interrupted_search_goes_on_in_the_halves_that_failed_too() -> None:
    """Reloads and devices that went offline began it again with the whole block, for ever."""
    found = words(*range(16))
    (whole,), bad = found.blocks, found.bad_addresses
    first, second = bad.refused(whole, 0, SILENT)
    assert bad.known().cuts == ()  # one failure may be noise
    bad.read(first)
    bad.refused(second, 0, SILENT)
    assert bad.known().cuts == (("D", 8),)
    bad.abandon()
    found.plan()
    assert [block.span for block in found.blocks] == [Span("D", 0, 8), Span("D", 8, 8)]
    asker = Asker(found, {9})
    asker.settle()
    assert bad_numbers(found) == {9}
    assert not bad.rejoin(0.0)
    assert bad.rejoin(SPLIT_FIRST)


def test_a_search_that_is_dropped_goes_on_after_one_failure_of_the_whole_block() -> None:
    """With reloads more often than a search takes, the whole block was tried for ever."""
    found = words(*range(16))
    (whole,), bad = found.blocks, found.bad_addresses
    bad.refused(whole, 0, SILENT)
    bad.abandon()
    assert bad.is_suspect(whole.span)  # the engine halves it after one failure
    bad.refused(whole, 0, SILENT)
    assert bad.known().cuts == (("D", 8),)


def test_two_blocks_that_fall_silent_in_turn_are_both_found_and_a_reload_forgets_none() -> None:
    """Each fall counted for the last block alone, and a reload began the count again."""
    old, new, other = words(0, 100), words(0, 100), words(0)
    one, two = old.blocks
    for block in (one, two):
        old.bad_addresses.fell_silent(block)
        assert not old.bad_addresses.is_suspect(block.span)
    new.take_over(old)
    other.take_over(old)
    for block in (one, two):
        new.bad_addresses.fell_silent(block)
        assert new.bad_addresses.is_suspect(block.span)
        new.bad_addresses.read(block)
        new.bad_addresses.fell_silent(block)
        assert not new.bad_addresses.is_suspect(block.span)
        new.bad_addresses.read(block)
    assert new.bad_addresses.clear
    other.bad_addresses.read(one)
    assert other.bad_addresses.clear  # it has no block of D100


def test_a_changed_device_goes_on_with_the_searches_of_the_one_before() -> None:
    old, new, other = words(*range(16)), words(*range(16)), words(*range(8))
    (whole,) = old.blocks
    old.bad_addresses.refused(whole, 0, SILENT)
    new.take_over(old)
    assert new.bad_addresses.is_suspect(whole.span)
    other.take_over(old)
    assert other.bad_addresses.clear  # it has no such block

    again = words(*range(16))
    for half in new.bad_addresses.refused(whole, 0, SILENT):
        new.bad_addresses.read(half)
    again.take_over(new)
    for half in again.bad_addresses.refused(whole, 0, SILENT):
        again.bad_addresses.read(half)
    again.bad_addresses.settle(0.0)
    assert again.bad_addresses.cuts == {("D", 8)}  # both times the halves were read
    assert not again.bad_addresses.rejoin(0.0)
    last = words(*range(16))
    last.bad_addresses.restore(again.bad_addresses.known(), last.tags)
    last.take_over(again)
    assert last.bad_addresses.rejoin(SPLIT_FIRST)  # it does not begin again with each change


def test_a_bad_address_in_a_faster_block_is_cut_off() -> None:
    """Its boundaries lie in a gap of the faster tags: they must be kept there too."""
    fast = [make_tag(f"D{n}", every=0.1) for n in (0, 1, 8, 9)]
    found = device([*fast, make_tag("D5", every=5.0)])
    assert [block.span for block in found.blocks] == [Span("D", 0, 10)]
    asker = Asker(found, {5})
    asker.settle()
    assert bad_numbers(found) == {5}
    assert sorted(block.span.start for block in found.blocks) == [0, 5, 8]


def test_a_bad_range_keeps_its_time_code_and_tags() -> None:
    found = words(3)
    (block,) = found.blocks
    assert found.bad_addresses.refused(block, 77, "28") == ()
    (bad,) = found.bad_addresses.bad.values()
    assert (bad.span, bad.since, bad.code, bad.tags) == (block.span, 77, "28", block.tags)
    assert found.bad_addresses.refused(block, 99, "28") == ()
    assert found.bad_addresses.bad[block.span].since == 77


def test_a_bad_address_is_read_more_and_more_rarely() -> None:
    found = words(3)
    (block,) = found.blocks
    assert found.interval(block) == 1.0
    intervals = []
    for _ in range(6):
        found.bad_addresses.refused(block, 0, "28")
        intervals.append(found.interval(block))
    assert intervals == [*RETRIES, RETRIES[-1], RETRIES[-1]]


def test_one_address_that_returned_has_all_others_tried_soon() -> None:
    found = words(3, 300)
    one, other = found.blocks
    for block in (one, other):
        for _ in range(4):
            found.bad_addresses.refused(block, 0, "28")
    assert found.bad_addresses.read(one)
    assert found.interval(one) == 1.0
    assert found.interval(other) == RETRIES[0]


def test_an_address_known_to_be_bad_from_an_earlier_run_is_read_rarely() -> None:
    earlier, found = words(3), words(3)
    earlier.bad_addresses.refused(earlier.blocks[0], 0, "28")
    found.bad_addresses.restore(earlier.bad_addresses.known(), found.tags)
    assert found.interval(found.blocks[0]) == RETRIES[-1]


def test_splits_are_tried_one_by_one_and_the_next_at_once_where_one_is_not_needed() -> None:
    """All were dropped together: a device with 20 silent gaps was offline for two minutes."""
    found = words(*range(16))
    bad = found.bad_addresses
    cuts = [("D", 4), ("D", 8), ("D", 12)]
    bad.restore(KnownBad((), tuple(cuts)), found.tags)
    found.plan()
    assert not bad.rejoin(0.0)
    assert bad.rejoin(SPLIT_FIRST)
    assert bad.cuts == {("D", 8), ("D", 12)}
    found.plan()
    bad.read(found.blocks[0])  # D0 to D7
    assert bad.rejoin(SPLIT_FIRST + 1.0)
    assert bad.cuts == {("D", 12)}
    found.plan()
    first, second = bad.refused(found.blocks[0], 0, SILENT)  # D0 to D11
    bad.read(first)
    bad.read(second)
    assert bad.settle(SPLIT_FIRST + 2.0)
    assert not bad.rejoin(SPLIT_FIRST + 3.0)  # another split may take its place
    assert bad.rejoin(10 * SPLIT_FIRST)  # the third
    assert bad.cuts == set()


def test_a_search_on_a_slow_line_ends_before_another_split_is_tried() -> None:
    """Each of its reads took ten seconds. The next plan dropped it, and it never ended."""
    found = words(*range(16))
    bad = found.bad_addresses
    bad.restore(KnownBad((), (("D", 8),)), found.tags)
    found.plan()
    assert not bad.rejoin(0.0)
    bad.refused(found.blocks[0], 0, SILENT)
    assert not bad.rejoin(SPLIT_FIRST)
    assert bad.searching
    assert bad.rejoin(2 * SPLIT_FIRST)  # but it waits for no search that does not end
