"""What a device tells of itself: the bytes are pymodbus' own."""

from collections.abc import Sequence
from typing import Any, cast

import pytest
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse
from pymodbus.pdu.other_message import ReportDeviceIdRequest, ReportDeviceIdResponse

from gateway.errors import NoReply, Refused
from gateway.protocols.modbus import Frame, ModbusAscii, ModbusRtu, ModbusTcp
from tests.protocols.modbus_peer import hearing

KINDS = (ModbusRtu, ModbusAscii, ModbusTcp)
BASIC = {0: b"ABB", 1: b"EV3 12", 2: b"V2.11"}
REGULAR = {**BASIC, 5: b"EV3"}
EXTENDED = {**REGULAR, 0x80: b"S/N 0012345"}


def framed(kind: Any, body: bytes, number: int = 1) -> bytes:
    driver = kind(station=1)
    coded: bytes = driver.codec().encode(Frame(1, body, number if kind is ModbusTcp else 0))
    return coded


def told(level: int, objects: dict[int, bytes]) -> bytes:
    """A reply to function 43/14."""
    pdu = ReadDeviceInformationResponse(read_code=level, information=cast("Any", objects))
    return bytes((pdu.function_code,)) + pdu.encode()


def server_id(text: bytes) -> bytes:
    """A reply to function 17."""
    pdu = ReportDeviceIdResponse(identifier=text)
    return bytes((pdu.function_code,)) + pdu.encode()


def bytewise(frames: Sequence[bytes]) -> list[bytes]:
    return [bytes((octet,)) for frame in frames for octet in frame]


def each(driver: Any, replies: Sequence[bytes]) -> Any:
    """A wire whose every request has its own reply, byte by byte."""
    return hearing(driver, *(bytewise([reply]) for reply in replies))


@pytest.mark.parametrize("kind", KINDS)
async def test_vendor_and_model_are_asked_by_function_43(kind: Any) -> None:
    driver = kind(station=1)
    for number, (names, level, objects) in enumerate(
        (({"vendor"}, 1, BASIC), ({"vendor", "model"}, 2, REGULAR)), 1
    ):
        talk = hearing(driver, bytewise([framed(kind, told(level, objects), number)]))
        found = await driver.identify(talk, names)
        request = ReadDeviceInformationRequest(read_code=level, object_id=0)
        asked = bytes((request.function_code,)) + request.encode()
        assert talk.sent == [framed(kind, asked, number)]
        assert found["vendor"] == ("ABB",)
        assert found.get("model", ("EV3",)) == ("EV3",)


@pytest.mark.parametrize("kind", KINDS)
async def test_a_serial_number_is_any_word_that_the_device_tells(kind: Any) -> None:
    """A serial number that only begins or ends alike is another one."""
    driver = kind(station=1)
    replies = [told(3, EXTENDED), server_id(b"Pump 77-B")]
    talk = each(driver, [framed(kind, body, n) for n, body in enumerate(replies, 1)])
    found = await driver.identify(talk, {"vendor", "serial"})
    assert {"0012345", "77-B"} <= set(found["serial"])
    assert not {"12345", "001234", "77"} & set(found["serial"])
    request = ReportDeviceIdRequest()
    assert talk.sent[1] == framed(kind, bytes((request.function_code,)) + request.encode(), 2)


@pytest.mark.parametrize("kind", KINDS)
async def test_function_17_is_enough_for_a_serial_number(kind: Any) -> None:
    driver = kind(station=1)
    talk = each(driver, [framed(kind, server_id(b"Pump 77-B"), 1)])
    assert "77-B" in (await driver.identify(talk, {"serial"}))["serial"]
    replies = [bytes.fromhex("91 01"), told(3, EXTENDED)]
    talk = each(driver, [framed(kind, body, n) for n, body in enumerate(replies, 2)])
    assert "0012345" in (await driver.identify(talk, {"serial"}))["serial"]
    refusals = [framed(kind, bytes.fromhex(text), n) for n, text in ((4, "91 01"), (5, "ab 01"))]
    with pytest.raises(Refused):
        await driver.identify(each(driver, refusals), {"serial"})
    with pytest.raises(Refused):
        await driver.identify(each(driver, [framed(kind, bytes.fromhex("ab 01"), 6)]), {"vendor"})


async def test_objects_may_come_in_several_replies() -> None:
    driver = ModbusTcp(station=1)
    first, last = bytearray(told(2, BASIC)), told(2, {4: b"Meter", 5: b"EV3"})
    first[4:6] = b"\xff\x04"  # more follows, from object 4 on (6.21)
    talk = each(driver, [framed(ModbusTcp, bytes(first), 1), framed(ModbusTcp, last, 2)])
    found = await driver.identify(talk, {"vendor", "model"})
    assert (found["vendor"], found["model"]) == (("ABB",), ("EV3",))
    assert talk.sent[1] == framed(ModbusTcp, bytes.fromhex("2b 0e 02 04"), 2)


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
async def test_an_echo_tells_nothing(kind: Any) -> None:
    driver = kind(station=1)
    echo, reply = framed(kind, bytes.fromhex("2b 0e 01 00")), framed(kind, told(1, BASIC))
    assert (await driver.identify(hearing(driver, bytewise([echo, reply])), {"vendor"}))["vendor"]
    with pytest.raises(NoReply):
        await driver.identify(hearing(driver, bytewise([echo])), {"vendor"})


@pytest.mark.parametrize("cut", range(1, 12))
async def test_half_a_reply_tells_nothing(cut: int) -> None:
    driver = ModbusTcp(station=1)
    body = told(1, BASIC)[:-cut]
    with pytest.raises(NoReply):
        await driver.identify(hearing(driver, [framed(ModbusTcp, body)]), {"vendor"})


def test_devices_of_other_dialects_are_not_asked() -> None:
    assert not ModbusRtu(station=1, addressing="vigor").identity_names
    assert not ModbusRtu(station=0).identity_names
