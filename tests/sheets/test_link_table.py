"""Communication tables of LINK and MBUS: the manual's examples as tags (VB/VH, B-3-3 and B-3-6)."""

from pathlib import Path

import pytest

from gateway.cli.sheets.import_command import add_tags
from gateway.config import load
from gateway.config.sheets import link_table, read_grid
from gateway.errors import ConfigError

LINK = """\
Number,Command,Master Data,,Slave ID,Slave Data,Length,Word / Bit
1,Read,D0,<--,5,D10,10,W
2,Write,M0,-->,2,M100,30,B
"""
MBUS = """\
Number;Command;Master Data;;Slave ID;Slave Data Type;Slave Data #;Length;Word/Bit
1;Read;D2000;<--;5;4;0;10;W
2;Write;D2010;-->;2;4;1000;5;W
3;Single Write;D2015;-->;3;4;2000;1;W
"""
LINK_REGISTERS = (2, 5, 1, 10, 13, 0, 13, 10, 2, 2, 30, 3, 0, 3, 100)
MBUS_REGISTERS = (
    3,
    5,
    1,
    10,
    13,
    2000,
    4,
    0,
    2,
    2,
    5,
    13,
    2010,
    4,
    1000,
    3,
    3,
    1,
    13,
    2015,
    4,
    2000,
)


def registers(values: tuple[int, ...]) -> str:
    rows = [f"D{1000 + place},{value}" for place, value in enumerate(values)]
    return "\n".join(["Register,Value", *rows])


def tags(text: str, station: int) -> dict[str, str]:
    """Access by address."""
    rows = link_table.of_station(read_grid(text.encode()), station).rows[1:]
    return {row.cells[1]: row.cells[2] for row in rows}


@pytest.mark.parametrize("text", [LINK, registers(LINK_REGISTERS)])
def test_the_manuals_easy_link_example(text: str) -> None:
    assert link_table.stations_in(read_grid(text.encode())) == [5, 2]
    assert tags(text, 5) == {f"D{number}": "r" for number in range(10, 20)}
    assert tags(text, 2) == {f"M{number}": "rw" for number in range(100, 130)}


@pytest.mark.parametrize("text", [MBUS, registers(MBUS_REGISTERS)])
def test_the_manuals_mbus_example(text: str) -> None:
    assert tags(text, 5) == {f"holding:{number}": "r" for number in range(10)}
    assert tags(text, 2) == {f"holding:{number}": "rw" for number in range(1000, 1005)}
    assert tags(text, 3) == {"holding:2000": "rw"}


def test_x_and_y_are_counted_in_octal() -> None:
    text = "Command,Master Data,Slave ID,Slave Data,Length\nRead,M0,1,X6,4\n"
    assert list(tags(text, 1)) == ["X6", "X7", "X10", "X11"]


def test_data_that_are_read_and_written_are_one_writable_tag() -> None:
    text = "Command,Master Data,Slave ID,Slave Data,Length\nRead,D0,1,D5,2\nWrite,D9,1,D6,1\n"
    assert tags(text, 1) == {"D6": "rw", "D5": "r"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LINK.replace("Read", "Copy"), "row 2: 'Copy' is neither Read nor Write"),
        (LINK.replace(",10,W", ",65,W"), "row 2: length 65 is not 1 to 64"),
        (LINK.replace("D10,", "D1x,"), "row 2: 'D1x' is no address such as D10"),
        (LINK.replace("M100", "X8"), "row 3: X8 has no octal number"),
        (LINK.replace(",5,D10", ",five,D10"), "row 2: 'five' is no number"),
        (LINK.replace(",10,W", ",100000,W"), "row 2: '100000' is no number"),
        (LINK.replace(",10,W", ",10000,W"), "row 2: length 10000 is not 1 to 64"),
        (MBUS.replace("5;4;0", "5;2;0"), "row 2: 2 is no device type: 0, 1, 3, 4"),
        (registers(LINK_REGISTERS[:-1]), "D1000 says 2 rows of 7 registers; there are 13"),
        (registers((1, 5, 9, 10, 13, 0, 13, 10)), "row 3: 9 is no command"),
        (registers((1, 5, 1, 8, 3, 0, 1, 8)), "use the table of Ladder Master"),
        ("Register,Value\nD1000,1\nD1002,5\n", "row 3: D1001 is missing"),
        (registers((1, 5, 1, 1, 13, 8, 6, 100)), "row 3: the PLC refuses device type 6"),
        (registers((1, 5, 2, 1, 13, 8, 3, 100)), "refuses device type 3 .* for command 2"),
        (
            registers((2, 5, 1, 1, 13, 8, 3, 100, 5, 1, 1, 13, 8, 13, 100)),
            "row 10: one instruction cannot have this row and the first one",
        ),
        (MBUS.replace("D2000", "M2000"), "holding:0 and M2000 are a bit and a word"),
    ],
)
def test_a_mistake_is_told_with_its_row(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        tags(text, 2 if "X8" in text else 5)


def test_the_device_of_the_master_decides_between_types_of_link_and_mbus() -> None:
    words = registers((1, 5, 1, 4, 13, 8, 3, 100))  # D8.. <- 30100..
    assert list(tags(words, 5)) == [f"input:{number}" for number in range(100, 104)]
    bits = registers((1, 5, 1, 4, 3, 8, 4, 8))  # M8.. <- S8..
    assert list(tags(bits, 5)) == ["S8", "S9", "S10", "S11"]
    assert list(tags(registers((1, 5, 2, 2, 3, 8, 0, 8)), 5)) == ["coil:8", "coil:9"]


def test_a_single_write_has_no_length() -> None:
    for length in ("7", ""):
        text = MBUS.replace("3;4;2000;1;W", f"3;4;2000;{length};W")
        assert tags(text, 3) == {"holding:2000": "rw"}
    assert tags(registers((1, 3, 3, 200, 13, 2015, 4, 2000)), 3) == {"holding:2000": "rw"}


def test_a_row_of_bits_names_contacts_of_timers() -> None:
    text = "Command,Master Data,Slave ID,Slave Data,Length,Word / Bit\nRead,M0,1,T5,2,B\n"
    assert list(tags(text, 1)) == ["TS5", "TS6"]


def test_the_manuals_list_between_two_vb_at_a_device_with_vigor_addressing(tmp_path: Path) -> None:
    plant, table = tmp_path / "plant.yaml", tmp_path / "mbus.csv"
    device = "{protocol: modbus-rtu, station: 1, addressing: vigor, tags: {}}"
    plant.write_text(f"lines:\n  hall:\n    port: simulator\n    devices:\n      vb: {device}\n")
    titles = "Command,Master Data,Slave ID,Slave Data Type,Slave Data #,Length\n"
    table.write_text(f"{titles}Read,D10,1,4,0000,1\nWrite,D0,1,4,0100,1\nWrite,M8,1,0,520,1\n")
    add_tags(table, plant, [], backup=False)
    (device_,) = load(plant).devices
    assert {tag.name: tag.text for tag in device_.tags} == {"d0": "D0", "d100": "D100", "m8": "M8"}
    table.write_text(f"{titles}Read,D10,1,3,0,1\n")
    with pytest.raises(ConfigError, match=r"input:0 is no address of this device"):
        add_tags(table, plant, [], backup=False)


def test_a_station_that_the_table_does_not_have() -> None:
    with pytest.raises(ConfigError, match="no row for station 7: it has 5, 2"):
        tags(LINK, 7)


PLANT = """\
lines:
  hall:
    port: simulator
    devices:
      mixer: {protocol: vigor, station: 5, tags: {}}
      oven: {protocol: vigor, station: 2, tags: {}}
"""


def test_each_device_gets_the_rows_of_its_station(tmp_path: Path) -> None:
    plant, table = tmp_path / "plant.yaml", tmp_path / "link.csv"
    plant.write_text(PLANT)
    table.write_text(LINK)
    add_tags(table, plant, [], backup=False)
    mixer, oven = load(plant).devices
    assert [tag.name for tag in mixer.tags] == [f"d{number}" for number in range(10, 20)]
    assert len(oven.tags) == 30
    assert all(tag.write is not None for tag in oven.tags)
    table.write_text(LINK.replace(",2,M100", ",9,M100"))
    with pytest.raises(ConfigError, match=r"no device with station 9, which link\.csv names"):
        add_tags(table, plant, [], backup=False)
