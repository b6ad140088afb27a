"""The rows of a communication table as transfers: printed, or added to the file."""

from pathlib import Path

import pytest

from gateway.cli.sheets.communication_table import import_transfers
from gateway.cli.sheets.export import export
from gateway.config import load
from gateway.errors import ConfigError
from tests.sheets.test_link_table import LINK, LINK_REGISTERS, MBUS, registers

PLC = "      plc: {protocol: vigor, station: 1}\n"
VIGOR = PLC + "".join(f"      {n}: {{protocol: vigor, station: {n[1:]}}}\n" for n in ("s2", "s5"))
MODBUS = """\
  field:
    port: simulator
    devices:
      m2: {protocol: modbus-rtu, station: 2}
      m3: {protocol: modbus-rtu, station: 3}
      m5: {protocol: modbus-rtu, station: 5}
"""


def written(folder: Path, table: str, devices: str, more: str = "") -> tuple[Path, Path]:
    sheet, file = folder / "table.csv", folder / "plant.yaml"
    sheet.write_text(table)
    file.write_text(f"lines:\n  hall:\n    port: simulator\n    devices:\n{devices}{more}")
    return sheet, file


@pytest.mark.parametrize("table", [LINK, registers(LINK_REGISTERS)])
def test_the_manuals_easy_link_example_becomes_two_rows(tmp_path: Path, table: str) -> None:
    sheet, file = written(tmp_path, table, VIGOR)
    before = file.read_text()
    import_transfers(sheet, file, "plc", dry_run=True)
    assert [file.read_text(), len([*tmp_path.iterdir()])] == [before, 2]
    import_transfers(sheet, file, "plc")
    assert file.read_text().startswith(before)
    assert [rule.text for rule in load(file).transfers] == [
        ("s5:D10..D19", "plc:D0..D9"),
        ("plc:M0..M29", "s2:M100..M129"),
    ]
    assert {rule.every for rule in load(file).transfers} == {1.0}
    assert (tmp_path / "plant.yaml.bak").read_text() == before


def test_the_manuals_mbus_example_becomes_rows_to_modbus_slaves(tmp_path: Path) -> None:
    sheet, file = written(tmp_path, MBUS, PLC, MODBUS)
    import_transfers(sheet, file, "plc")
    assert [rule.text for rule in load(file).transfers] == [
        ("m5:holding:0..holding:9", "plc:D2000..D2009"),
        ("plc:D2010..D2014", "m2:holding:1000..holding:1004"),
        ("plc:D2015", "m3:holding:2000"),
    ]


def test_without_a_file_the_rows_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet, _ = written(tmp_path, LINK, VIGOR)
    import_transfers(sheet, None, "plc")
    assert (
        '  - {from: "station-5:D10..D19", to: "plc:D0..D9", every: 1s}' in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("table", "devices", "more", "master", "said"),
    [
        (LINK, VIGOR, "", "plk", "there is no device plk"),
        (LINK, PLC, "", "plc", "has no device with station 5 or 2"),
        (LINK, VIGOR, "transfers: []\n", "plc", "has `transfers:` already"),
        ("Name,Address\na,D1\n", VIGOR, "", "plc", "is no communication table"),
        (LINK.replace("D0", "Q0"), VIGOR, "", "plc", "Q0: there is no device Q"),
    ],
)
def test_a_mistake_changes_nothing(
    tmp_path: Path, table: str, devices: str, more: str, master: str, said: str
) -> None:
    sheet, file = written(tmp_path, table, devices, more)
    before = file.read_text()
    with pytest.raises(ConfigError, match=said):
        import_transfers(sheet, file, master)
    assert file.read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plant.yaml", "table.csv"]


def test_ranges_are_no_tags_of_an_exported_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet, file = written(tmp_path, LINK, VIGOR)
    file.write_text(file.read_text().replace("station: 2", "station: 2, tags: {x: {address: D1}}"))
    import_transfers(sheet, file, "plc")
    capsys.readouterr()
    export(file)
    out = capsys.readouterr().out
    assert "s2,x,D1" in out
    assert "ranges/" not in out
