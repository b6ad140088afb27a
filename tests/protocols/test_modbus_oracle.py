"""The Modbus drivers against pymodbus: what we send it reads, what it answers we read."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.pdu.bit_message import (
    ReadCoilsResponse,
    ReadDiscreteInputsResponse,
    WriteMultipleCoilsResponse,
    WriteSingleCoilResponse,
)
from pymodbus.pdu.exceptionresponse import ExceptionResponse
from pymodbus.pdu.pdu import ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterResponse,
)

from gateway.errors import Refused, Unclear
from gateway.protocols.driver import Span
from tests.protocols.modbus_peer import KINDS, hearing, oracle_decodes, oracle_encodes

MODERATE = settings(max_examples=120, deadline=None)
kinds = st.sampled_from(KINDS)
stations = st.integers(1, 247)
FUNCTIONS = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
READ_ANSWERS = {
    "coil": ReadCoilsResponse,
    "discrete": ReadDiscreteInputsResponse,
    "holding": ReadHoldingRegistersResponse,
    "input": ReadInputRegistersResponse,
}


@MODERATE
@given(kinds, stations, st.sampled_from(sorted(FUNCTIONS)), st.integers(0, 65535), st.data())
async def test_reads_are_the_oracles_reads(
    kind: type, station: int, area: str, start: int, data: st.DataObject
) -> None:
    bits = area in ("coil", "discrete")
    unit = st.integers(0, 1 if bits else 0xFFFF)
    room = min(65536 - start, 300 if bits else 125)
    units = data.draw(st.lists(unit, min_size=1, max_size=room))
    driver, span = kind(station=station), Span(area, start, len(units))
    spread = {"bits": [bool(u) for u in units]} if bits else {"registers": units}
    answer = READ_ANSWERS[area](dev_id=station, transaction_id=1, **spread)
    talk = hearing(driver, [oracle_encodes(kind, answer)])
    assert list(await driver.read(talk, span)) == units
    asked = oracle_decodes(kind, talk.sent[0], station, requests=True)
    assert (asked.function_code, asked.address, asked.count) == (FUNCTIONS[area], start, len(units))
    cost = driver.cost(span)
    assert cost == (len(talk.sent[0]), len(oracle_encodes(kind, answer)))
    assert talk.replies == [cost.reply]


@MODERATE
@given(kinds, stations, st.booleans(), st.booleans(), st.integers(0, 65535), st.data())
async def test_writes_are_the_oracles_writes(
    kind: type, station: int, bits: bool, single: bool, start: int, data: st.DataObject
) -> None:
    unit = st.integers(0, 1 if bits else 0xFFFF)
    room = min(65536 - start, 200 if bits else 123)
    units = data.draw(st.lists(unit, min_size=1, max_size=room))
    driver = kind(station=station, write_single=single)
    span = Span("coil" if bits else "holding", start, len(units))
    shared: dict[str, Any] = {"dev_id": station, "transaction_id": 1, "address": start}
    answer: ModbusPDU
    if single and len(units) == 1:
        answer = (
            WriteSingleCoilResponse(bits=[bool(units[0])], **shared)
            if bits
            else WriteSingleRegisterResponse(registers=units, **shared)
        )
    else:
        many = WriteMultipleCoilsResponse if bits else WriteMultipleRegistersResponse
        answer = many(count=len(units), **shared)
    talk = hearing(driver, [oracle_encodes(kind, answer)])
    assert await driver.write(talk, span, units) is True
    asked = oracle_decodes(kind, talk.sent[0], station, requests=True)
    assert (asked.function_code, asked.address) == (answer.function_code, start)
    assert [int(u) for u in (asked.bits if bits else asked.registers)] == units
    cost = driver.write_cost(span)
    assert cost == (len(talk.sent[0]), len(oracle_encodes(kind, answer)))


@MODERATE
@given(kinds, stations, st.integers(1, 6), st.booleans())
async def test_the_oracles_exceptions_are_refusals(
    kind: type, station: int, code: int, writing: bool
) -> None:
    driver, span = kind(station=station), Span("holding", 7, 2)
    refused = ExceptionResponse(16 if writing else 3, code, device_id=station, transaction=1)
    talk = hearing(driver, [oracle_encodes(kind, refused)])
    perhaps_done = writing and code in (4, 5)  # a failure in the middle, or done later
    with pytest.raises(Unclear if perhaps_done else Refused) as no:
        await (driver.write(talk, span, [1, 2]) if writing else driver.read(talk, span))
    if isinstance(no.value, Refused):
        assert no.value.code == f"{code:02d}"
