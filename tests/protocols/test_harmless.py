"""Reads of a resync: inside the configured spans, and told from the outstanding requests."""

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.protocols.driver import EVERY_REQUEST, PROOF, AnyDriver, Span
from gateway.protocols.harmless import ENDS_FOR, HarmlessReads
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from tests.doubles import Wire

DRIVERS: list[ModbusRtu | ModbusAscii | Vigor] = [
    ModbusRtu(station=1),
    ModbusAscii(station=1),
    Vigor(station=1),
]


def area_of(driver: AnyDriver) -> str:
    return "D" if driver.protocol == "vigor" else "holding"


async def resynced(
    driver: AnyDriver, outstanding: Span | None, token: int, spans: list[Span]
) -> tuple[int, int, bytes]:
    """Returns the claim of the driver, the length of the reply, and the request."""
    station: Any = station_for(driver, [])
    wire = Wire(driver, lambda data: station.hear(data, 0.0))
    told = await driver.resync(wire, outstanding, token, spans)
    [length] = wire.replies
    return told, length, wire.sent[0]


@settings(max_examples=60)
@given(
    st.sampled_from(DRIVERS),
    st.lists(st.tuples(st.integers(0, 3000), st.integers(1, 30)), max_size=4),
    st.none() | st.tuples(st.integers(0, 3000), st.integers(1, 30)),
)
async def test_a_resync_is_told_from_as_many_requests_as_it_says(
    driver: AnyDriver, places: list[tuple[int, int]], late: tuple[int, int] | None
) -> None:
    area = area_of(driver)
    spans = [Span(area, *place) for place in places]
    outstanding = None if late is None else Span(area, *late)
    lengths = list[int]()
    cost = None if outstanding is None else driver.cost(outstanding)
    for token in range(2, 40, 2):
        told, length, _ = await resynced(driver, outstanding, token, spans)
        resyncs = told
        if cost is not None and told:
            assert length != cost.reply
            resyncs -= 1
        assert length not in lengths[len(lengths) - resyncs :] or not resyncs
        lengths.append(length)


@settings(max_examples=60)
@given(
    st.sampled_from(DRIVERS),
    st.lists(st.tuples(st.integers(0, 3000), st.integers(1, 30)), max_size=4),
    st.none() | st.tuples(st.integers(0, 3000), st.integers(1, 30)),
)
async def test_a_proof_differs_from_every_resync_and_from_the_outstanding_request(
    driver: ModbusRtu | ModbusAscii | Vigor,
    places: list[tuple[int, int]],
    late: tuple[int, int] | None,
) -> None:
    spans = [Span(area_of(driver), *place) for place in places]
    outstanding = None if late is None else Span(area_of(driver), *late)
    if driver.resync_shape(outstanding, PROOF, spans) is None:
        assert all(size < 30 for _, size in places)
        return
    told, proof, _ = await resynced(driver, outstanding, PROOF, spans)
    assert told == EVERY_REQUEST
    cost = None if outstanding is None else driver.cost(outstanding)
    assert cost is None or proof != cost.reply
    for token in range(200):
        _, length, _ = await resynced(driver, outstanding, token, spans)
        assert length != proof


@pytest.mark.parametrize(
    ("size", "outstanding", "used", "most", "proof"),
    [
        (20, None, (), 64, 9),  # resyncs have six forms in each place
        (20, 9, (), 64, 10),
        (20, None, (9, 10), 64, 11),
        (20, 9, (10,), 64, 11),
        (9, None, (), 64, 9),
        (9, 9, (), 64, None),
        (8, None, (), 64, None),
        (20, None, (), 8, None),  # no longer read is possible
    ],
)
def test_a_proof_has_a_form_of_its_own_inside_the_span(
    size: int, outstanding: int | None, used: tuple[int, ...], most: int, proof: int | None
) -> None:
    reads = HarmlessReads(
        [Span("D", 100, size)],
        None if outstanding is None else Span("D", 500, outstanding),
        lambda span: span.size if span.size <= most else None,
    )
    assert reads.proof(used) == (None if proof is None else Span("D", 100, proof))


@settings(max_examples=30)
@given(
    st.sampled_from(DRIVERS[:2]),
    st.lists(st.tuples(st.integers(0, 3000), st.integers(1, 30)), min_size=1, max_size=4),
    st.booleans(),
)
async def test_a_modbus_resync_reads_configured_registers_if_one_of_its_reads_is_told_apart(
    driver: AnyDriver, places: list[tuple[int, int]], pending: bool
) -> None:
    spans = [Span("holding", *place) for place in places]
    outstanding = spans[0] if pending else None
    if pending and all(span.size == 1 for span in spans):
        return
    held = {n for start, size in places for n in range(start, start + size)}
    for token in range(2, 40, 2):
        _, _, sent = await resynced(driver, outstanding, token, spans)
        data = sent if driver.protocol == "modbus-rtu" else bytes.fromhex(sent[1:-2].decode())
        first, count = int.from_bytes(data[2:4]), int.from_bytes(data[4:6])
        assert held.issuperset(range(first, first + count))


async def test_a_single_register_is_read_again_by_every_second_resync() -> None:
    """It cannot be told from the outstanding read, and the driver says so."""
    driver, only = DRIVERS[0], Span("holding", 300, 1)
    found = [await resynced(driver, only, token, [only]) for token in (2, 4, 6, 8)]
    again = [told for told, _, sent in found if sent[2:6] == bytes.fromhex("012c 0001")]
    assert again == [0, 0]
    assert sum(told > 0 for told, _, _ in found) == 2


async def test_a_bad_address_at_one_end_does_not_hide_the_device() -> None:
    driver, span = DRIVERS[0], Span("holding", 100, 20)
    tokens = range(2, 34, 2)
    firsts = [int.from_bytes((await resynced(driver, None, t, [span]))[2][2:4]) for t in tokens]
    assert firsts.count(100) == 8
    assert all(n > 100 for n in firsts if n != 100)


async def test_a_vigor_resync_reads_m0_and_configured_addresses_in_turn() -> None:
    driver, span = DRIVERS[2], Span("D", 100, 20)
    asked = [(await resynced(driver, None, t, [span]))[2][5:9] for t in (2, 4, 6, 8)]
    assert asked[1] == asked[3] == b"0080"
    assert b"0080" not in (asked[0], asked[2])


def registers(request: bytes) -> range:
    first, count = int.from_bytes(request[2:4]), int.from_bytes(request[4:6])
    return range(first, first + count)


@pytest.mark.parametrize("outstanding", [Span("holding", 100, 2), Span("holding", 103, 2)])
@pytest.mark.parametrize("numbered", [False, True])
def test_a_resync_leaves_out_the_read_that_had_no_reply(
    outstanding: Span, *, numbered: bool
) -> None:
    """The device may be silent about an address of it, at either end of the block."""
    block = Span("holding", 100, 5)
    reads = HarmlessReads([block, block], outstanding, DRIVERS[0].reply_shape, numbered)
    assert reads.are_beside
    for token in range(2, 40):
        assert not reads.pick(token).overlaps(outstanding)


def test_two_resyncs_in_a_row_do_not_read_the_same_end_of_a_block() -> None:
    block = Span("holding", 100, 120)
    reads = HarmlessReads([block, block], block, DRIVERS[0].reply_shape)
    at_begin = [reads.pick(token).start == 100 for token in range(2, 80, 2)]
    repeated = [one for one, other in pairwise(at_begin) if one is other]
    assert len(repeated) <= len(at_begin) // ENDS_FOR
    assert {at_begin[n] for n in range(0, len(at_begin), 2)} == {False, True}


async def test_nothing_near_a_register_is_read_that_is_known_as_bad() -> None:
    driver, bad = DRIVERS[0], Span("holding", 300, 1)
    spans = [Span("holding", n, 1) for n in (100, 200)]
    for token in range(2, 40):
        _, _, sent = await resynced(driver, bad, token, spans)
        assert 300 not in registers(sent)


async def test_of_two_registers_every_second_resync_leaves_out_the_silent_one() -> None:
    """No other read has another length; that of the good one is not told from the silent one."""
    driver, silent = DRIVERS[0], Span("holding", 101, 1)
    spans = [Span("holding", 100, 1), Span("holding", 100, 2)]
    found = [await resynced(driver, silent, token, spans) for token in (2, 4, 6, 8)]
    beside = [101 not in registers(sent) for _, _, sent in found]
    assert sorted(beside) == [False, False, True, True]
    assert beside[0] is not beside[1]
    assert [told > 0 for told, _, _ in found] == [not one for one in beside]
