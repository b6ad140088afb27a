"""The cost model against figures of the manuals and by hand."""

import pytest

from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.protocols.driver import Cost, Timing


@pytest.mark.parametrize(
    ("serial_format", "bits"),
    [("7E1", 10), ("8N1", 10), ("8E1", 11), ("8N2", 11), ("7N1", 9), ("8O2", 12)],
)
def test_a_character_has_a_start_bit_data_parity_and_stop_bits(
    serial_format: str, bits: int
) -> None:
    assert character_bits(serial_format) == bits


@pytest.mark.parametrize(("characters", "milliseconds"), [(270, 140.6), (266, 138.5)])
def test_the_longest_vigor_frames_take_141_and_139_ms_at_19200(
    characters: int, milliseconds: float
) -> None:
    assert WireTiming(19200, 10).character * characters * 1000 == pytest.approx(
        milliseconds, abs=0.1
    )


def test_rtu_keeps_3_5_characters_of_silence_or_the_configured_time() -> None:
    rtu = Timing(silence=0.00175, silence_chars=3.5)
    assert WireTiming(9600, 11).silence(rtu) == pytest.approx(3.5 * 11 / 9600)
    assert WireTiming(115200, 11).silence(rtu) == 0.00175
    assert WireTiming(9600, 11).silence(Timing(silence=0.01, silence_chars=3.5)) == 0.01


def test_a_transaction_is_silence_request_turnaround_and_reply() -> None:
    wire, timing = WireTiming(9600, 10), Timing(turnaround=0.02, silence=0.005)
    cost = Cost(14, 12)
    assert wire.transaction(cost, timing) == pytest.approx(0.005 + 26 / 960 + 0.02)
    assert wire.transaction(cost, timing, 0.1) == pytest.approx(0.005 + 26 / 960 + 0.1)
    assert wire.transaction(cost, timing, 0.0) == pytest.approx(0.005 + 26 / 960)
