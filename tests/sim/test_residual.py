"""Wrong values that pass every check: a part of the counts of `twice.py`."""

import pytest

from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from tests.sim.noise import Format
from tests.sim.residual import Case
from tests.sim.twice import BARE, CASES, counted, in_a_row, theory

SUM = CASES[0]  # Vigor without parity
STRONG = (
    Case("vigor 7E1", Vigor(station=1), Span("D", 100, 1), Format(7, parity=True)),
    Case("modbus-rtu 8N1", ModbusRtu(station=1), Span("holding", 100, 1), Format(8)),
)


@pytest.mark.parametrize("case", STRONG, ids=lambda case: case.name)
def test_parity_with_a_sum_and_a_crc_detect_all_one_and_two_bit_errors(case: Case) -> None:
    assert theory(case).ways == {}


@pytest.mark.parametrize(
    ("case", "fewest", "rate", "readings"), [(SUM, 2, 1e-3, 12_000), (BARE, 1, 3e-3, 1200)]
)
def test_reading_twice_leaves_at_most_the_square_of_the_share(
    case: Case, fewest: int, rate: float, readings: int
) -> None:
    """The counted share is that of the theory. The chance is seeded, so every run is equal."""
    known = theory(case)
    assert known.fewest == fewest
    once, twice = known.shares(rate)
    assert twice < once**2
    found = counted(case, rate, fewest, readings)
    assert found.once.low < once < found.once.high
    assert found.twice.low < twice < found.twice.high
    assert found.twice.value < found.once.value**2
    assert found.twice.hits > 0
    if case is BARE:  # frequent enough to be met by simply reading
        plain = in_a_row(case, rate, 6000)
        assert 0 < plain.low < twice < plain.high
