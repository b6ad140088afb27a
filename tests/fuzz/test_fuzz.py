"""Any received bytes, file or payload gives a value or an error of the gateway.

The suite runs a few examples; `make fuzz EXAMPLES=200000` runs many.
"""

import os
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.config import ConfigErrors, load
from gateway.contract.parsing import parse_write
from gateway.errors import BadValue, GatewayError
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from tests.doubles import Wire, result_of

EXAMPLES = int(os.environ.get("EXAMPLES", "150"))
often = settings(
    max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), database=None
)
DRIVERS: dict[str, tuple[AnyDriver, Span]] = {
    "vigor": (Vigor(station=1), Span("D", 100, 4)),
    "link-1": (ComputerLink(station=1), Span("D", 100, 4)),
    "link-4": (ComputerLink(station=1, frame_format=4), Span("D", 100, 4)),
    "link-sumless": (ComputerLink(station=1, sum_check=False), Span("D", 100, 4)),
    "rtu": (ModbusRtu(station=1), Span("holding", 100, 4)),
    "ascii": (ModbusAscii(station=1), Span("holding", 100, 4)),
    "tcp": (ModbusTcp(station=1), Span("holding", 100, 4)),
}
# Parts of frames, so that more examples pass the first checks of a codec.
BYTES = st.lists(
    st.one_of(
        st.sampled_from([b"\x02", b"\x03", b"\x05", b"\x06", b"\x15", b"\r\n", b":", b"01", b"00"]),
        st.sampled_from([b"\x01\x03\x08", b"\x06015100", b"\x0201FF", b"\x0601FF", b":0103"]),
        st.binary(max_size=12),
    ),
    max_size=12,
).map(b"".join)


def pieces(data: bytes, size: int) -> list[bytes]:
    return [data[first : first + size] for first in range(0, len(data), size)]


@pytest.mark.parametrize("name", DRIVERS)
@often
@given(received=BYTES, piece=st.integers(1, 40))
def test_any_received_bytes_give_words_or_a_gateway_error(
    name: str, received: bytes, piece: int
) -> None:
    driver, span = DRIVERS[name]
    try:
        units = result_of(driver.read(Wire(driver, lambda _: pieces(received, piece)), span))
    except GatewayError:
        return
    assert len(units) == span.size
    assert all(0 <= unit <= 0xFFFF for unit in units)


@pytest.mark.parametrize("name", DRIVERS)
@often
@given(data=st.data())
def test_a_damaged_reply_is_right_or_refused_except_for_undetectable_errors(
    name: str, data: st.DataObject
) -> None:
    """One byte of a good reply is changed: every checksum detects that."""
    driver, span = DRIVERS[name]
    if name in ("link-sumless", "tcp"):
        return  # without a checksum
    station = station_for(driver, ())
    words = data.draw(st.lists(st.integers(0, 0xFFFF), min_size=4, max_size=4))
    station.memory.write(span.area, span.start, words)

    def damaged(request: bytes) -> list[bytes]:
        reply = bytearray(b"".join(station.hear(request, 1.0)))
        place = data.draw(st.integers(0, len(reply) - 1))
        reply[place] ^= data.draw(st.integers(1, 255))
        return pieces(bytes(reply), 40)

    with suppress(GatewayError):
        assert list(result_of(driver.read(Wire(driver, damaged), span))) == words


@pytest.mark.parametrize("name", DRIVERS)
@often
@given(received=BYTES)
def test_a_simulated_station_survives_any_bytes(name: str, received: bytes) -> None:
    driver, _ = DRIVERS[name]
    station = station_for(driver, ())
    for now, byte in enumerate(received):
        station.hear(bytes([byte]), float(now) / 1000)
    station.hear(received, 100.0)


@often
@given(st.one_of(st.binary(max_size=60), st.text(max_size=40).map(str.encode)))
def test_any_payload_is_a_value_or_is_refused(payload: bytes) -> None:
    with suppress(BadValue):
        assert isinstance(parse_write(payload), (bool, int, float, str))


WORDS = (
    "gateway zenoh defaults lines devices tags port simulator protocol vigor modbus-rtu station "
    "address D100 M12 holding:5 every 1s write true name prefix format 7E1 baudrate 9600 "
    "verify_reads <<: *a &a [ ] { } - 1 0 -5 1e999 null ~ '' : # ! | >"
)
WORD = st.sampled_from(WORDS.split(" "))
LINES = st.lists(
    st.tuples(st.integers(0, 4), st.lists(st.one_of(WORD, st.text(max_size=6)), max_size=4)),
    max_size=14,
)


@often
@given(lines=LINES)
def test_any_file_gives_a_configuration_or_a_list_of_mistakes(
    tmp_path_factory: pytest.TempPathFactory, lines: list[tuple[int, list[str]]]
) -> None:
    path = _folder(tmp_path_factory) / "config.yaml"
    text = "\n".join("  " * depth + ": ".join(words) for depth, words in lines)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with suppress(ConfigErrors):
        assert load(path).lines is not None


def _folder(factory: pytest.TempPathFactory) -> Path:
    return factory.getbasetemp()
