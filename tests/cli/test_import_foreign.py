"""Sheets and projects of other programs: values by one command each, and what is left out."""

import io
import zipfile
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

import pytest

from gateway.config import load
from gateway.config.sheets import read_grid, read_sheet, workbooks
from gateway.errors import ConfigError
from gateway.stations.registry import station_of
from gateway.values import Value
from tests.conftest import Command

FOREIGN = Path(__file__).with_name("foreign")
VIGOR = """\
lines:
  hall:
    port: simulator
    devices:
      plc: {protocol: vigor, station: 1}
"""
MODBUS = VIGOR.replace("vigor", "modbus-rtu")
# The registers of every station, by number; 12.5 is 4148 0000, first word high in 100, low in 102.
WORDS = {100: 0x4148, 103: 0x4148, 104: 0xFFFE, 105: 0xEE90, 106: 0x0800, 30: 123}
BITS = {5: 1, 7: 1}
GMWIN = ("--address", "%MW=holding:", "--address", "%MX=coil:")


def values(config: Path) -> dict[str, Value | None]:
    """Returns the value that each tag has of these registers."""
    found: dict[str, Value | None] = {}
    for device in load(config).devices:
        memory = station_of(device.driver).memory
        for tag in device.tags:
            area, first, size = tag.span
            cells = BITS if tag.unit_kind.value == "bit" else WORDS
            for number in range(first, first + size):
                memory.write(area, number, [cells.get(number, 0)])
            found[tag.key] = tag.decode(memory.read(*tag.span))
    return found


@pytest.mark.parametrize(
    ("file", "before", "options", "expected"),
    [
        (
            "german.xls",
            VIGOR,
            (),
            {"plc/Drehzahl_Pumpe_1": 1671.2, "plc/Druck": 12.5, "plc/Start": True},
        ),
        (
            "gx-works3.csv",
            VIGOR,
            (),
            {"plc/speed": 0x4148, "plc/pressure": 12.5, "plc/start": True},
        ),
        (
            "gmwin.csv",
            MODBUS,
            GMWIN,
            {"plc/FLOW": 12.5, "plc/RUNNING": True, "plc/PRESSURE": 2048},
        ),
        (
            "wb-mqtt-serial.json",
            MODBUS,
            (),
            {
                "plc/Gas_pressure": 12.3,
                "plc/Flow": 12.5,
                "plc/Running": True,
                "plc/Door": True,
                "plc/Door_no._2": True,
            },
        ),
        (
            "kepware.json",
            "",
            (),
            {
                "Boiler/Flow": 12.5,
                "Boiler/Burner/Running": True,
                "Boiler/Burner/Gas/Pressure": 12.3,
            },
        ),
        (
            "neuron.json",
            "",
            (),
            {
                "boiler/flow": 12.5,
                "boiler/flow2": 12.5,
                "boiler/running": True,
                "boiler/pressure": 14.8,
                "meter/door": True,
                "meter/count": 2048,
            },
        ),
        (
            "telegraf.conf",
            "",
            (),
            {
                "boiler/running": True,
                "boiler/door": True,
                "boiler/energy": -70.0,
                "boiler/flow": 12.5,
                "boiler/pressure": 12.3,
                "meters-3/water/flow": 12.5,
                "meters-4/door": True,
            },
        ),
        (
            "home-assistant.yaml",
            "",
            (),
            {
                "boiler/Gas_pressure": 14.8,
                "boiler/flow": 12.5,
                "boiler/door": True,
                "boiler/running": True,
            },
        ),
    ],
)
def test_one_command_makes_values_of_a_sheet_or_project(
    command: Command,
    tmp_path: Path,
    file: str,
    before: str,
    options: tuple[str, ...],
    expected: dict[str, Value],
) -> None:
    plant = tmp_path / "plant.yaml"
    if before:
        plant.write_text(before)
    done = command("import", FOREIGN / file, "--into", plant, *options)
    assert done.code == 0, done.err
    assert values(plant) == expected
    fitting = command("import", FOREIGN / file, "--into", tmp_path / "new.yaml", *options)
    assert (fitting.code == 0) is (before == "")  # a project needs no file


@pytest.mark.parametrize(
    ("file", "left"),
    [
        ("kepware.json", "left out: Root, because of servermain.TAG_SCALING_CLAMP_LOW true"),
        ("home-assistant.yaml", "left out: broken, because of nan_value 32767"),
        ("wb-mqtt-serial.json", "left out: Sensor, because of error_value 0x7FFF"),
        ("wb-mqtt-serial.json", "left out: Level, without an address"),
        ("gx-works3.csv", "1 tags left out: the PLC's program chose their addresses itself"),
    ],
)
def test_a_tag_that_would_have_another_value_is_left_out_and_named(
    command: Command, file: str, left: str
) -> None:
    assert left in command("import", FOREIGN / file).err


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        # the order of the two words is unknown
        ('"endianess": 4', '"timeout2": 4', "neuron.json: tag 1, word_order: "),
        ('"2!400103"', '"2!499999"', "neuron.json: tag 1, address: "),
        ('"drivers": [', '"drivers": [[', "this looks like a project of neuron, but: "),
    ],
)
def test_a_mistake_in_a_project_names_its_tag(
    command: Command, tmp_path: Path, old: str, new: str, problem: str
) -> None:
    file = tmp_path / "neuron.json"
    file.write_text((FOREIGN / "neuron.json").read_text().replace(old, new))
    done = command("import", file, "--into", tmp_path / "plant.yaml")
    assert done.code == 2
    assert problem in done.err
    assert not (tmp_path / "plant.yaml").exists()


@pytest.mark.parametrize(
    "text",
    [
        '{"servermain.X": ' + 100_000 * "[",
        "[[inputs.modbus]]\nx = " + 100_000 * "[",
        "modbus:\n" + 80_000 * "- a: b\n",
        "modbus: [*a]\n",
    ],
)
def test_a_project_that_is_none_is_refused_soon(text: str) -> None:
    with pytest.raises(ConfigError, match="this looks like a project of "):
        read_grid(text.encode())


def test_lists_in_lists_do_not_grow() -> None:
    names = "abcdefghij"
    grown = [f"{b}: &{b} [{','.join(9 * [f'*{a}'])}]" for a, b in pairwise(names)]
    with pytest.raises(ConfigError, match="it has no tag that can be read here"):
        read_grid("\n".join(["a: &a [x]", *grown, "modbus: *j", ""]).encode())


def test_a_dry_run_checks_and_writes_nothing(command: Command, tmp_path: Path) -> None:
    plant = tmp_path / "plant.yaml"
    new = command("import", FOREIGN / "neuron.json", "--into", plant, "--dry-run")
    assert new.out.splitlines()[-1] == "nothing was written: --dry-run"
    assert not plant.exists()
    plant.write_text(VIGOR)
    done = command("import", FOREIGN / "german.xls", "--into", plant, "--dry-run")
    assert (done.code, plant.read_text()) == (0, VIGOR)
    assert [path.name for path in tmp_path.iterdir()] == ["plant.yaml"]
    wrong = command("import", FOREIGN / "gmwin.csv", "--into", plant, "--dry-run")
    assert wrong.code == 2


def test_columns_can_be_chosen_and_names_are_never_comments(
    command: Command, tmp_path: Path
) -> None:
    sheet = tmp_path / "tags.csv"
    sheet.write_text("KKS;Address;Comment;Name\nLAB10;D1;feed pump;x\nLAB20;D2;feed pump;y\n")
    done = command("import", sheet, "--columns", "name=KKS")
    assert "LAB10: {address: D1, description: feed pump}" in done.out
    sheet.write_text("KKS;Address;Comment\nLAB10;D1;feed pump\nLAB20;D2;feed pump\n")
    wrong = command("import", sheet)
    assert wrong.code == 2
    assert "column A (KKS): names? Then add --columns name=KKS" in wrong.err
    assert "no row has the titles Tag" in command("import", sheet, "--columns", "name=Tag").err
    assert "have two sides" in command("import", sheet, "--columns", "name").err


# ---- workbooks -----------------------------------------------------------------------------------


EMPTY = '<table:table-row table:number-rows-repeated="3"><table:table-cell/></table:table-row>'


def ods(rows: list[list[object]], first: str = "") -> bytes:
    def cell(value: object) -> str:
        kind = f'office:value-type="float" office:value="{value}"' if value == 0.1 else ""
        return f"<table:table-cell {kind}><text:p>{escape(str(value))}</text:p></table:table-cell>"

    body = "".join(f"<table:table-row>{''.join(map(cell, row))}</table:table-row>" for row in rows)
    spaces = " ".join(
        f'xmlns:{name}="urn:oasis:names:tc:opendocument:xmlns:{name}:1.0"'
        for name in ("office", "table", "text")
    )
    end = f"{EMPTY.replace('3', '1048576')}"
    content = f"<x {spaces}><table:table>{first}{body}{end}</table:table></x>"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("content.xml", content)
    return stream.getvalue()


def test_an_ods_file_has_rows_numbers_and_errors_of_formulas() -> None:
    data = ods([["Name", "Adresse", "Faktor"], ["a", "D1", 0.1], ["b", "D2", "Err:502"]], EMPTY)
    sheet = read_sheet(read_grid(data), "mixer", (), str)
    assert sheet.tags["a"] == {"address": "D1", "scale": 0.1}
    (mistake,) = sheet.mistakes
    assert (mistake.row, mistake.column) == (6, "column C (Faktor)")


def test_a_workbook_that_grows_without_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workbooks, "_MOST_ROWS", 200)
    full = "<table:table-cell><text:p>x</text:p></table:table-cell>"
    row = f'<table:table-row table:number-rows-repeated="9000000">{full}</table:table-row>'
    with pytest.raises(ConfigError, match="more than 200 rows"):
        read_grid(ods([["Name", "Address"]], row))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("content.xml", b" " * 2_100_000)
    monkeypatch.setattr(workbooks, "_MOST_BYTES", 2_000_000)
    with pytest.raises(ConfigError, match="more than 2 MB"):
        read_grid(stream.getvalue())


def test_a_damaged_workbook_is_read_or_a_mistake() -> None:
    data, wrong = (FOREIGN / "german.xls").read_bytes(), []
    for at in range(331, len(data), 331):
        try:
            read_grid(data[:at] + b"\xff\x00\x81" + data[at + 3 :])
        except ConfigError as error:
            wrong.append(str(error))
    assert {text.partition(":")[0] for text in wrong} == {"the file is no .xls file, or damaged"}
