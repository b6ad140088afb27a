"""Every checked Modbus frame, through the codecs and through the drivers."""

from collections.abc import Sequence

import pytest

from gateway.errors import NoReply, Refused
from gateway.protocols.driver import Span
from gateway.protocols.modbus import (
    AsciiCodec,
    Frame,
    ModbusAscii,
    ModbusRtu,
    RtuCodec,
    RtuSlaveCodec,
)
from tests.doubles import Script
from tests.protocols.modbus_peer import hearing
from tests.vectors import Vector, vectors

ALL = vectors("modbus-rtu", "modbus-ascii")
GOOD = [vector for vector in ALL if vector.valid]
REQUESTS = [vector for vector in GOOD if vector.direction == "request"]
RESPONSES = [vector for vector in GOOD if vector.direction == "response"]
AREAS = {1: "coil", 2: "discrete", 3: "holding", 4: "input", 5: "coil", 6: "holding"}
AREAS |= {15: "coil", 16: "holding"}


def frame_of(vector: Vector) -> Frame:
    return Frame(vector.fields["unit"], bytes.fromhex(vector.fields["pdu"]))


def driver_for(vector: Vector, station: int, **settings: object) -> ModbusRtu | ModbusAscii:
    kind = ModbusRtu if vector.protocol == "modbus-rtu" else ModbusAscii
    if "device" in vector.fields:
        settings["addressing"] = vector.fields["dialect"]
    return kind(station=station, **settings)  # type: ignore[arg-type]  # YAML settings


def count_of(pdu: bytes) -> int:
    return 1 if pdu[0] in (5, 6) else int.from_bytes(pdu[3:5], "big")


def units_of(pdu: bytes) -> list[int]:
    """Returns the values in a write request."""
    match pdu[0]:
        case 5:
            return [int(pdu[3] == 0xFF)]
        case 6:
            return [int.from_bytes(pdu[3:5], "big")]
        case 15:
            return [pdu[6 + i // 8] >> i % 8 & 1 for i in range(count_of(pdu))]
        case _:
            return [int.from_bytes(pdu[i : i + 2], "big") for i in range(6, len(pdu), 2)]


@pytest.mark.parametrize("vector", GOOD, ids=repr)
def test_the_codec_reads_and_writes_the_frame(vector: Vector) -> None:
    frame = frame_of(vector)
    if vector.protocol == "modbus-ascii":
        assert AsciiCodec().feed(vector.frame) == [frame]
        assert AsciiCodec().feed(vector.frame.lower()) == [frame]
        assert AsciiCodec().encode(frame) == vector.frame
    else:
        codec = RtuCodec() if vector.direction == "response" else RtuSlaveCodec(frame.station)
        assert codec.feed(vector.frame) == [frame]
        assert RtuCodec().encode(frame) == RtuSlaveCodec(1).encode(frame) == vector.frame


@pytest.mark.parametrize("vector", [v for v in ALL if not v.valid], ids=repr)
def test_a_bad_frame_is_ignored(vector: Vector) -> None:
    codecs = (
        [AsciiCodec()]
        if vector.protocol == "modbus-ascii"
        else [RtuSlaveCodec(0), RtuSlaveCodec(1)]
    )
    for codec in codecs:
        assert codec.feed(vector.frame) == []


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
async def test_the_driver_sends_the_request(vector: Vector) -> None:
    station, pdu, _ = frame_of(vector)
    function, count = pdu[0], count_of(pdu)
    driver = driver_for(vector, station, write_single=function in (5, 6))
    if "device" in vector.fields:
        device = vector.fields["device"]
        if function in (1, 5, 15) and device[0] in "TC":
            device = f"{device[0]}S{device[1:]}"  # the contact; T and C alone are the value
        address = driver.address(device)
    else:
        address = driver.address(f"{AREAS[function]}:{int.from_bytes(pdu[1:3], 'big')}")
    if driver.areas[address.area].unit == "dword":
        count //= 2
    span = Span(address.area, address.number, count)
    script = Script(driver, f"> {vector.frame.hex(' ')}")
    if function <= 4:
        cost = driver.cost(span)
        with pytest.raises(NoReply):
            await driver.read(script, span)
    else:
        cost = driver.write_cost(span)
        if station == 0:
            assert await driver.write(script, span, units_of(pdu)) is False
        else:
            with pytest.raises(NoReply):
                await driver.write(script, span, units_of(pdu))
    script.done()
    assert cost is not None
    assert cost.request == len(vector.frame)
    assert script.replies == ([cost.reply] if station else [])


def question_for(answer: bytes) -> tuple[Span, Sequence[int] | None]:
    """A span and what is written to it, so that `answer` fits as the answer."""
    function = answer[0] & 0x7F
    span = Span(AREAS[function], 0, 1)
    match function:
        case 1 | 2 if len(answer) > 2:
            return span._replace(size=8 * answer[1]), None
        case 3 | 4 if len(answer) > 2:
            return span._replace(size=answer[1] // 2), None
        case 1 | 2 | 3 | 4:
            return span, None
        case 5 | 6:
            start, value = int.from_bytes(answer[1:3], "big"), int.from_bytes(answer[3:], "big")
            return span._replace(start=start), [value]
    if len(answer) == 2:
        return span._replace(size=2), [0, 0]
    start, size = int.from_bytes(answer[1:3], "big"), count_of(answer)
    return span._replace(start=start, size=size), [0] * size


@pytest.mark.parametrize("vector", RESPONSES, ids=repr)
async def test_the_driver_understands_the_answer(vector: Vector) -> None:
    frame = frame_of(vector)
    answer = frame.pdu
    driver = driver_for(vector, frame.station)
    span, units = question_for(answer)
    script = hearing(driver, [vector.frame])
    asked = driver.read(script, span) if units is None else driver.write(script, span, units)
    if answer[0] & 0x80:
        with pytest.raises(Refused) as refused:
            await asked
        assert refused.value.code == f"{answer[1]:02X}"
    elif units is not None:
        assert await asked is True
    else:
        bits = [byte >> i & 1 for byte in answer[2:] for i in range(8)]
        words = [int.from_bytes(answer[i : i + 2], "big") for i in range(2, len(answer), 2)]
        heard = await asked
        assert not isinstance(heard, bool)
        assert list(heard) == (bits if answer[0] <= 2 else words)
        assert script.replies == [len(vector.frame)]
