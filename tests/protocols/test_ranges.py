"""Ranges of addresses in requests that the protocol can carry."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.ranges import addresses, spans
from gateway.protocols.vigor import Vigor

DRIVERS: list[tuple[AnyDriver, str]] = [
    (Vigor(station=1), "D"),
    (Vigor(station=1), "M"),
    (ComputerLink(station=1), "D"),
    (ModbusRtu(station=1), "holding"),
    (ModbusRtu(station=1), "coil"),
]


@given(st.sampled_from(DRIVERS), st.integers(0, 400), st.integers(1, 300))
def test_the_parts_are_the_range_and_each_fits_a_request(
    known: tuple[AnyDriver, str], start: int, size: int
) -> None:
    driver, area = known
    numbers = range(start, start + size)
    parts = list(spans(driver, area, numbers))
    assert [n for part in parts for n in range(part.start, part.start + part.size)] == list(numbers)
    assert all(driver.cost(part) is not None for part in parts)


def test_a_range_is_limited() -> None:
    assert addresses(Vigor(), "D0..D255", 256) == ("D", range(256))
    with pytest.raises(ConfigError, match="more than 256 addresses"):
        addresses(Vigor(), "D0..D256", 256)
