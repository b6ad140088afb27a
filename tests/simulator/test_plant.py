"""The built-in plant: every value moves within its type, and what is written stays."""

from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusTcp
from gateway.simulator.plant import station_for
from gateway.tags import Tag
from gateway.values import Value
from tests.doubles import Wire
from tests.e2e.processes import ROOT, write_config

MINUTES = [float(second) for second in range(0, 600, 7)]


def device(folder: Path, tags: dict[str, Any], **settings: Any) -> tuple[AnyDriver, list[Tag]]:
    section = {"protocol": "vigor", "station": 1, "tags": tags, **settings}
    line = {"port": "simulator", "devices": {"plc": section}}
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", {"hall": line})
    [found] = load(path).devices
    return found.driver, list(found.tags)


def seen(driver: AnyDriver, tags: list[Tag]) -> dict[str, list[Value | None]]:
    memory = station_for(driver, tags).memory
    return {tag.name: [tag.decode(memory.read(*tag.span, now)) for now in MINUTES] for tag in tags}


NUMBERS = ["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "bcd16"]


@pytest.mark.parametrize("kind", [*NUMBERS, "bcd32"])
def test_numbers_of_every_type_move(tmp_path: Path, kind: str) -> None:
    driver, tags = device(tmp_path, {"a": {"address": "D10", "type": kind}})
    values = seen(driver, tags)["a"]
    assert len(set(values)) > 10
    assert all(isinstance(value, (int, float)) and 10 <= value <= 90 for value in values)


@pytest.mark.parametrize("address", ["X17", "Y20", "M12", "S5", "TS5", "CC5", "M9003", "D7.3"])
def test_bits_move(tmp_path: Path, address: str) -> None:
    driver, tags = device(tmp_path, {"a": {"address": address}})
    assert set(seen(driver, tags)["a"]) == {True, False}


@pytest.mark.parametrize(
    ("scale", "offset"), [(0.1, 0), (10, 0), (1, 40), (-0.5, 100), (1000, 0), (0.001, 0)]
)
def test_scaled_numbers_move_in_their_own_units(
    tmp_path: Path, scale: float, offset: float
) -> None:
    tag = {"address": "D10", "type": "int32", "scale": scale, "offset": offset}
    driver, tags = device(tmp_path, {"a": tag})
    values = seen(driver, tags)["a"]
    assert all(value is not None for value in values)
    if scale < 100:
        assert len(set(values)) > 5


def test_neighbours_do_not_move_alike(tmp_path: Path) -> None:
    driver, tags = device(tmp_path, {f"d{i}": {"address": f"D{i}"} for i in range(20)})
    motions = [tuple(values) for values in seen(driver, tags).values()]
    assert len(set(motions)) == len(motions)


def test_a_text_is_there(tmp_path: Path) -> None:
    driver, tags = device(
        tmp_path,
        {
            "long": {"address": "D600", "type": "string[16]"},
            "s": {"address": "D1", "type": "string[3]"},
        },
    )
    values = seen(driver, tags)
    assert set(values["long"]) == {"SIMULATED"}
    assert set(values["s"]) == {"SIM"}


def test_what_can_be_written_stands_still_within_its_limits(tmp_path: Path) -> None:
    tags = {
        "a": {"address": "D1", "write": {"min": 1, "max": 4}},
        "b": {"address": "D2", "write": True},
        "c": {"address": "D3.4", "write": True},
        "d": {"address": "Y7", "write": True},
    }
    driver, made = device(tmp_path, tags)
    values = seen(driver, made)
    assert {name: len(set(found)) for name, found in values.items()} == dict.fromkeys(tags, 1)
    [value] = set(values["a"])
    assert isinstance(value, int)
    assert 1 <= value <= 4


def test_a_written_value_stays(tmp_path: Path) -> None:
    driver, [tag] = device(tmp_path, {"a": {"address": "D1"}})
    memory = station_for(driver, [tag]).memory
    memory.write("D", 1, [1234])
    assert {memory.read("D", 1, 1, now)[0] for now in MINUTES} == {1234}


def test_every_device_of_the_example_has_its_plc() -> None:
    config = load(ROOT / "config.example.yaml")
    assert {device.driver.protocol for device in config.devices} == {
        "vigor",
        "computer-link",
        "modbus-rtu",
        "modbus-tcp",
    }
    for found in config.devices:
        for name, values in seen(found.driver, list(found.wire_tags)).items():
            assert None not in values, name


@pytest.mark.parametrize("order", ["low_first", "high_first"])
async def test_a_modbus_plc_has_the_drivers_word_order(order: Any) -> None:
    """A counter from C200 on is two registers: what comes over the wire is what is held."""
    driver = ModbusTcp(addressing="vigor", counter_word_order=order)
    station = station_for(driver, [])
    station.memory.write("C32", 207, [0x12345678])

    talk = Wire(driver, lambda request: station.hear(request, 0.0))
    assert await driver.read(talk, Span("C32", 207, 1)) == [0x12345678]


@pytest.mark.parametrize(
    ("settings", "address", "kind"),
    [
        ({"protocol": "vigor"}, "D100", "uint16[64]"),
        ({"protocol": "vigor"}, "M0", "bool[128]"),
        ({"protocol": "vigor"}, "C200", "int32[8]"),
        ({"protocol": "computer-link"}, "D0100", "float32[16]"),
        ({"protocol": "computer-link"}, "M0005", "bool[30]"),
        ({"protocol": "modbus-rtu"}, "holding:7", "int32[60]"),
        ({"protocol": "modbus-ascii"}, "coil:3", "bool[77]"),
        ({"protocol": "modbus-tcp"}, "holding:7", "bcd16[50]"),
        ({"protocol": "modbus-rtu", "addressing": "vigor"}, "D10", "float64[10]"),
    ],
)
async def test_an_array_moves_and_is_written_in_one_exchange(
    tmp_path: Path, settings: dict[str, Any], address: str, kind: str
) -> None:
    rows = {"a": {"address": address, "type": kind}}
    driver, [tag] = device(tmp_path, rows, **settings)
    station = station_for(driver, [tag])
    count, clock = tag.layout.type.count, iter(MINUTES)
    talk = Wire(driver, lambda request: station.hear(request, next(clock)))
    found = set()
    for _ in range(5):
        value = tag.decode(await driver.read(talk, tag.span))
        assert isinstance(value, tuple)
        assert len(value) == count
        found |= set(value)
    assert len(talk.sent) == 5
    assert len(found) > 1
    new: Value = tuple(number % 2 == 0 for number in range(count))
    if tag.layout.type.is_number:
        new = tuple(range(1000, 1000 + count))
    assert await driver.write(talk, tag.span, tag.encode(new))
    assert len(talk.sent) == 6
    assert tag.decode(await driver.read(talk, tag.span)) == new


def test_no_plc_speaks_no_protocol(tmp_path: Path) -> None:
    class Foreign:
        protocol = "foreign"

    with pytest.raises(ConfigError, match="no simulated device for protocol foreign"):
        station_for(Foreign(), [])  # type: ignore[arg-type]  # that is the point
