"""Replies over swapped wires, heard by a model of a receiver on an inverted line."""

import random
from collections.abc import Callable

import pytest

from gateway.errors import Evidence, Garbled
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.swapped import KnownReplies, is_swapped
from gateway.protocols.vigor import Vigor
from tests.sim.plant import made_device
from tests.vectors import Vector, vectors


def levels(data: bytes, bits: int, parity: str) -> list[int]:
    """The line, with a rest before and after."""
    line = [1] * 4
    for character in data:
        places = [character >> place & 1 for place in range(bits)]
        line += [0, *places]
        if parity == "E":
            line.append(sum(places) % 2)
        line.append(1)
    return line + [1] * 30


def received(line: list[int], bits: int, parity: str) -> bytes:
    """What a receiver takes from the line: a break first, then a byte after each change to 0."""
    length, got, place = bits + (parity != "N") + 2, [0], 0
    while line[place] == 0:
        place += 1
    while place + length < len(line):
        if (line[place - 1], line[place]) != (1, 0):
            place += 1
            continue
        taken = line[place + 1 : place + 1 + bits]
        got.append(sum(bit << at for at, bit in enumerate(taken)))
        place += length - 1
    return bytes(got)


def over_swapped_wires(data: bytes, bits: int, parity: str) -> bytes:
    return received([1 - level for level in levels(data, bits, parity)], bits, parity)


DRIVERS: dict[str, tuple[Callable[[int], AnyDriver], int, str]] = {
    "vigor": (lambda station: Vigor(station=station), 7, "E"),
    "fxlink": (lambda station: ComputerLink(station=station), 7, "E"),
    "modbus-rtu": (lambda station: ModbusRtu(station=station), 8, "N"),
    "modbus-ascii": (lambda station: ModbusAscii(station=station), 7, "E"),
}
READS = {"51", "BR", "WR", 1, 2, 3, 4}


def is_read(vector: Vector) -> bool:
    """A good reply to a read, from a station that the file can have."""
    frame, good = vector.frame, vector.valid and vector.direction == "response"
    match vector.protocol:
        case "vigor":
            return good and frame[3:7] == b"5100"
        case "fxlink":
            return good and frame[:1] == b"\x02" and frame[3:5] == b"FF"
        case "modbus-rtu":
            return good and frame[1] <= 4 and frame[0] > 0
        case _:
            return good and frame[3:5] in (b"01", b"02", b"03", b"04") and frame[1:3] != b"00"


REPLIES = [vector for vector in vectors(*DRIVERS) if is_read(vector)]


def station_of(vector: Vector) -> int:
    return vector.frame[0] if vector.protocol == "modbus-rtu" else int(vector.frame[1:3], 16)


@pytest.mark.parametrize("vector", REPLIES, ids=str)
def test_replies_of_the_manuals_are_recognised_on_swapped_wires(vector: Vector) -> None:
    make, bits, parity = DRIVERS[vector.protocol]
    driver = make(station_of(vector))
    assert isinstance(driver, KnownReplies)
    assert is_swapped(over_swapped_wires(vector.frame, bits, parity), driver)
    assert not is_swapped(vector.frame, driver)


def test_each_protocol_was_tried() -> None:
    assert {vector.protocol for vector in REPLIES} == set(DRIVERS)


@pytest.mark.parametrize("protocol", DRIVERS)
def test_noise_is_hardly_ever_taken_for_swapped_wires(protocol: str) -> None:
    chance, driver = random.Random(2), DRIVERS[protocol][0](1)
    assert isinstance(driver, KnownReplies)
    noises = [chance.randbytes(chance.randrange(3, 40)) for _ in range(2000)]
    assert sum(is_swapped(noise, driver) for noise in noises) <= 20


def test_the_diagnosis_names_the_wires() -> None:
    driver = Vigor(station=1)
    plc = made_device("plc", driver, WireTiming(19200, 10), driver.timing, ())
    heard = over_swapped_wires(b"\x0601510034F2\x03C1", 7, "E")
    plc.health.trouble = Garbled("no whole frame", heard, evidence=Evidence.NOISE)
    assert "A and B are swapped" in plc.diagnosis()
    plc.health.trouble = Garbled("no whole frame", b"\x55\x12\x99", evidence=Evidence.NOISE)
    assert "every bit" not in plc.diagnosis()
