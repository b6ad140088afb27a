"""Sheets of tags: files of several programs, and every mistake with its row and column."""

import io
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from openpyxl import Workbook

from gateway.config import ConfigErrors, load
from gateway.config.sheets import Sheet, cells, grid, read_grid, read_sheet
from gateway.config.sheets.columns import columns_of, letter
from gateway.config.sheets.tags import other_settings, parsed
from gateway.errors import ConfigError
from gateway.tags import WriteRule
from tests.sheets import plant

PLANT = """\
gateway: {name: demo}
defaults: {write: true}
lines:
  hall-1:
    port: simulator
    devices:
      mixer:
        protocol: vigor
        station: 1
        tags_from: tags.csv
"""


def sheet(text: str | bytes, device: str = "mixer") -> Sheet:
    data = text.encode() if isinstance(text, str) else text
    return read_sheet(read_grid(data), device, other_settings(), parsed)


def as_xlsx(points: list[plant.Point]) -> bytes:
    book = Workbook()
    book.create_sheet("Cover").append(["Plant", "South"])
    tags = book.create_sheet("Tags")
    tags.append(["Name", "Address", "Scale", "R/W", "Every"])
    for point in points:
        tags.append([point.name, point.address, point.scale, point.writable, "500ms"])
    tags.append([None, None])
    stream = io.BytesIO()
    book.save(stream)
    return stream.getvalue()


def mistakes(tmp_path: Path, text: str | bytes, config: str = PLANT) -> list[str]:
    (tmp_path / "tags.csv").write_bytes(text.encode() if isinstance(text, str) else text)
    (tmp_path / "plant.yaml").write_text(config, encoding="utf-8")
    with pytest.raises(ConfigErrors) as caught:
        load(tmp_path / "plant.yaml")
    return list(caught.value.messages)


# ---- the same plant from several programs --------------------------------------------------------


@pytest.mark.parametrize("dialect", ["english", "german", "kepware"])
def test_a_plant_of_300_tags_is_the_same_from_every_program(dialect: str, tmp_path: Path) -> None:
    points = plant.points()
    (tmp_path / "tags.csv").write_bytes(getattr(plant, dialect)(points))
    (tmp_path / "plant.yaml").write_text(PLANT, encoding="utf-8")
    (mixer,) = load(tmp_path / "plant.yaml").devices
    assert len(mixer.tags) == 300
    for tag, point in zip(mixer.tags, points, strict=True):
        assert (tag.name, tag.text, str(tag.layout.type)) == (point.name, point.address, point.type)
        assert (tag.label.unit, tag.label.description) == (point.unit, point.comment)
        assert tag.shaping.scale == (point.scale or 1)
        # `R` in the sheet is stronger than `write: true` in the defaults.
        assert tag.write == (WriteRule() if point.writable else None)


def test_device_comments_of_a_plc_program_become_names_and_descriptions() -> None:
    points = plant.points(20)
    found = sheet(plant.device_comments(points))
    assert list(found.tags)[:2] == ["Pumpe_0_Süd_Größe_0", "Pumpe_1_Süd_Größe_1"]
    assert [raw["address"] for raw in found.tags.values()] == [point.address for point in points]
    assert [raw["description"] for raw in found.tags.values()] == [p.comment for p in points]


def test_equal_comments_get_the_address_into_their_names() -> None:
    found = sheet("Device\tComment\nM1\tpump runs\nM2\tpump runs\nM3\t\n")
    assert list(found.tags) == ["pump_runs", "pump_runs_M2", "M3"]


def test_an_empty_label_takes_the_comment_but_an_empty_name_is_a_mistake() -> None:
    text = "Device,{},Comment\nM1,,pump runs\nM2,run,\n"
    assert list(sheet(text.format("Label")).tags) == ["pump_runs", "run"]
    (mistake,) = sheet(text.format("Name")).mistakes
    assert (mistake.row, mistake.what) == (2, "no name")


def test_an_xlsx_file_has_its_tags_on_any_sheet() -> None:
    point = plant.Point("level", "40101", "int16", "", 0.1, "", writable=True)
    assert sheet(as_xlsx([point])).tags == {
        "level": {"address": "40101", "scale": 0.1, "write": True, "every": "500ms"}
    }


def test_numbers_of_an_xlsx_file_are_written_as_excel_shows_them() -> None:
    texts = [grid.cell_text(cell) for cell in (40101.0, 0.1 + 0.2, 1e20, True, None, 7)]
    assert texts == ["40101", "0.3", "1e+20", "true", "", "7"]


# ---- encodings, delimiters, titles ---------------------------------------------------------------

CHINESE = "位址,名稱,單位,註解,讀寫\nD100,馬達轉速,rpm,攪拌機馬達的轉速,讀寫\n"


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "big5", "gb18030"]
)
def test_chinese_titles_are_read_in_every_encoding(encoding: str) -> None:
    found = sheet(CHINESE.encode(encoding))
    (raw,) = found.tags.values()
    assert list(found.tags) == ["馬達轉速"]
    assert (raw["address"], raw["write"]) == ("D100", True)


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1", "utf-8"])
def test_western_letters_are_read(encoding: str) -> None:
    found = sheet("Name;Adresse;Einheit\nKühler;D1;°C\n".encode(encoding))
    assert found.tags == {"Kühler": {"address": "D1", "unit": "°C"}}


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
def test_the_delimiter_is_found_or_told_by_sep(delimiter: str) -> None:
    text = f'Comment{delimiter}Name{delimiter}Address\n"a,b;c\nd"{delimiter}x{delimiter}D1\n'
    found = sheet(f"sep={delimiter}\n{text}" if delimiter == "|" else text)
    assert found.tags == {"x": {"address": "D1", "description": "a,b;c d"}}


def test_rows_are_counted_as_the_spreadsheet_shows_them() -> None:
    text = (
        'sep=;\r\nPlant;;\r\n\r\nName;Address;Scale\r\na;D1;1\r\n"b\r\nc";D2;x\r\n# x;;\r\n;;\r\n'
    )
    found = sheet(text)
    assert found.mistakes == [(5, "column C (Scale)", "'x' is no number")]


def test_columns_have_letters() -> None:
    assert [letter(index) for index in (0, 25, 26, 701, 702)] == ["A", "Z", "AA", "ZZ", "AAA"]


def test_a_setting_that_a_column_gives_in_part_has_its_place() -> None:
    found = sheet("Name,Address,Min\nx,D1,5\n")
    assert found.columns["write"] == found.columns["min"] == "column C (Min)"


def test_a_title_that_is_nearly_known_is_a_mistake_and_another_is_reported() -> None:
    found = sheet("Name,Address,Scael,Cabinet\nx,D1,0.1,A7\n")
    assert found.mistakes == [(1, "column C (title)", "no column of tags: did you mean Scale?")]
    assert found.notes == ["columns not used: Cabinet"]


def test_labels_of_a_plc_program_have_their_devices_and_types() -> None:
    found = sheet(
        "Class\tLabel Name\tData Type\tAssign (Device/Label)\tComment\tRemark\n"
        "VAR_GLOBAL\tspeed\tWord [Signed]\tD100\tSpeed of the mixer\t\n"
        "VAR_GLOBAL\tlevel\tFLOAT [Single Precision]\tD10\t\t\n"
    )
    assert found.tags == {
        "speed": {"address": "D100", "description": "Speed of the mixer", "type": "int16"},
        "level": {"address": "D10", "type": "float32"},
    }
    assert found.notes == ["columns not used: Class, Remark"]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("Name,Comment\nspeed,x\n", "no column Address; the titles are Name, Comment"),
        ("Address,Type\nD1,int16\n", "no column Name, and no Comment to make names of"),
        ("Name,Address\n,D1\n", "no name"),
        ("Name,Address\nspeed,\n", "no address: fill it in, or begin a row that is no tag with #"),
    ],
)
def test_an_address_is_required_and_a_name_or_a_comment(text: str, what: str) -> None:
    assert [mistake.what for mistake in sheet(text).mistakes] == [what]
    named = sheet("Address,Comment\nD1,Motor speed\n")
    assert named.tags == {"Motor_speed": {"address": "D1", "description": "Motor speed"}}
    assert [*sheet(f"Address,Comment\nD1,{'long ' * 50}\n").tags] == ["D1"]  # too long for a name
    assert named.mistakes == []


def test_two_columns_of_one_meaning_are_a_mistake() -> None:
    columns = columns_of(["Name", "Address", "Scale", "Faktor"], ())
    assert columns.mistakes == [
        (3, "column C (Scale) has the same meaning: delete or rename one of them")
    ]


def test_a_setting_has_a_column_under_its_own_name() -> None:
    found = sheet("Name,Address,Publish,Heartbeat\nx,D1,always,30s\n")
    assert found.tags == {"x": {"address": "D1", "publish": "always", "heartbeat": "30s"}}


def test_a_sheet_of_several_devices_gives_each_its_rows() -> None:
    text = "Device,Name,Address\nmixer,a,D1\noven,b,D2\nmixer,c,D3\n"
    assert list(sheet(text).tags) == ["a", "c"]
    (mistake,) = sheet(text, "pump").mistakes
    assert mistake.what == "no row is of device pump: the sheet has mixer, oven"
    (mistake,) = sheet(text + ",d,D4\n").mistakes
    assert mistake.what == "no device, but other rows have one"


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "the sheet is empty"),
        (b"a;b\n1;2\n", "no row with titles of columns"),
        (b'Name;Address\n"x;D1\n', "row 2: a quote"),
        (b"\xd0\xcf\x11\xe0 old", "no .xls file, or damaged"),
        (b"PK\x03\x04 no archive", "no .xlsx file, or damaged"),
        (b"\xff\xfeN", "the file is damaged"),
    ],
)
def test_a_file_that_is_no_sheet_is_named_so(data: bytes, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        sheet(data)


@given(
    st.sampled_from([plant.german, plant.kepware, plant.device_comments, as_xlsx]),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 9), st.binary(max_size=4)), max_size=4),
)
@settings(deadline=None, max_examples=60)
def test_a_damaged_file_is_a_sheet_or_a_mistake(
    program: Callable[[list[plant.Point]], bytes], damages: list[tuple[float, int, bytes]]
) -> None:
    data = bytearray(program(plant.points(5)))
    for share, length, put in damages:
        at = int(share * len(data))
        data[at : at + length] = put
    with suppress(ConfigError):
        sheet(bytes(data))


# ---- cells ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "decimal", "value"),
    [
        ("0,1", None, 0.1),
        ("0.1", None, 0.1),
        ("1,0", None, 1),
        ("1E3", None, 1000),
        ("1,5E-3", ",", 0.0015),
        ("-2", None, -2),
        ("\u22122,5", None, -2.5),
        ("1.234,5", None, 1234.5),
        ("1,234,567.5", None, 1234567.5),
        ("1 234", None, 1234),
        ("1,000", ",", 1),
        ("1,000", ".", 1000),
        ("0,001", None, 0.001),
        ("9007199254740993", None, 9007199254740993),
    ],
)
def test_numbers_are_read_as_people_and_spreadsheets_write_them(
    text: str, decimal: str | None, value: float
) -> None:
    assert cells.number(text, decimal) == value
    assert isinstance(cells.number(text, decimal), type(value))


def test_a_number_with_two_meanings_is_refused_unless_the_sheet_tells() -> None:
    with pytest.raises(ConfigError, match=r"1,250 can mean 1\.25 or 1250: write one of them"):
        cells.number("1,250", None)
    rows = "Name;Address;Scale\na;D1;1,250\n"
    assert sheet(rows).mistakes
    assert sheet(rows + "b;D2;0,5\n").tags["a"]["scale"] == 1.25
    assert sheet(rows.replace(",", ".") + "b;D2;0,5\n").tags["a"]["scale"] == 1250
    assert sheet(rows.replace(",", ".").replace(";", ",")).tags["a"]["scale"] == 1.25


@pytest.mark.parametrize("text", ["12 mm", "1.2.3", "1.234.5", "01. Mai", "1,,2", "--1", "e5", "½"])
def test_other_texts_are_no_numbers(text: str) -> None:
    with pytest.raises(ConfigError, match="is no number"):
        cells.number(text, None)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("500 ms", "", "500 ms"),
        ("1h30m", "", "1h30m"),
        ("0,5 Sek", "", "0.5s"),
        ("0,5", "", 0.5),
        ("500", "ms", "500ms"),
        ("1,500", "s", "1.5s"),
    ],
)
def test_durations(text: str, unit: str, value: str | float) -> None:
    assert cells.duration(text, unit) == value


@pytest.mark.parametrize("text", ["0=off;1=auto", "0: off, 1: auto", "{0: 'off', 1: \"auto\"}"])
def test_names_of_numbers(text: str) -> None:
    assert cells.names(text) == {"0": "off", "1": "auto"}


@pytest.mark.parametrize("text", ["off", "0=off;", "0=off;0=auto", "0=;1=auto"])
def test_other_texts_name_no_numbers(text: str) -> None:
    with pytest.raises(ConfigError, match="does not name numbers: write 0=off;1=auto"):
        cells.names(text)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("INT", "int16"),
        ("Word", "uint16"),
        ("Word [Signed]", "int16"),
        ("Double Word [Unsigned]/Bit String [32-bit]", "uint32"),
        ("REAL", "float32"),
        ("FLOAT (Single Precision)", "float32"),
        ("LReal", "float64"),
        ("Bit", "bool"),
        ("STRING(16)", "string[16]"),
        ("uint16[50]", "uint16[50]"),
        ("WORD[50]", "uint16[50]"),
        ("REAL(8)", "float32[8]"),
        ("ARRAY[0..49] OF INT", "int16[50]"),
        ("Array [1..30] of Bool", "bool[30]"),
        ("float[single precision]", "float32"),
        ("THING[3]", "THING[3]"),
        ("string", "string[8]"),
        ("Default", None),
        ("INT33", "INT33"),  # the configuration refuses it with the list of types
    ],
)
def test_types_of_other_programs_are_known(text: str, kind: str | None) -> None:
    assert cells.kind(text, "8") == kind


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        *((text, True) for text in ("R/W", "RW", "read/write", "WAHR", "x", "1", "L/S", "读写")),
        *((text, False) for text in ("R", "RO", "Read Only", "FALSCH", "nein", "0", "-", "唯讀")),
    ],
)
def test_access_is_read_in_three_languages(text: str, allowed: bool) -> None:
    assert cells.access(text) is allowed


def test_times_take_their_unit_from_the_cell_or_the_title() -> None:
    text = "Name;Address;Abtastrate [ms];Totband\na;D1;500;0,5\nb;D2;0,5 s;2 %\n"
    assert sheet(text).tags == {
        "a": {"address": "D1", "every": "500ms", "deadband": 0.5},
        "b": {"address": "D2", "every": "0.5s", "deadband": "2%"},
    }


def test_a_range_becomes_scale_and_offset() -> None:
    text = "Name,Address,Raw Low,Raw High,Eng Low,Eng High\na,D1,4000,20000,0,100\n"
    assert sheet(text).tags["a"] == {"address": "D1", "scale": 0.00625, "offset": -25}
    (mistake,) = sheet(text.replace(",100\n", ",\n")).mistakes
    assert mistake.what.startswith("a range needs its four ends")


def test_limits_count_for_tags_that_can_be_written() -> None:
    text = "Name,Address,R/W,Min,Max,Verify\na,D1,R/W,1,40,yes\nb,D2,R,1,40,yes\n"
    assert sheet(text).tags == {
        "a": {"address": "D1", "write": {"verify": True, "min": 1, "max": 40}},
        "b": {"address": "D2", "write": False},
    }


@pytest.mark.parametrize(
    ("title", "first", "second"),
    [
        ("Divisor", "1", "10"),
        ("Decimal places", "0", "2"),
        ("Negate Value", "", "x"),
        ("Signed", "", "no"),
        ("Decimal places", "0", "1"),
        ("Slave ID", "1", "2"),
    ],
)
def test_a_column_that_would_change_values_is_not_left_out(
    title: str, first: str, second: str
) -> None:
    text = f"Name,Address,{title}\na,D1,{first}\nb,D2,"
    assert not sheet(f"{text}{first}\n").mistakes
    (mistake,) = sheet(f"{text}{second}\n").mistakes
    assert mistake.what.startswith("this column cannot be used: ")
    assert mistake[:2] == (1, f"column C ({title})")


def test_a_scaling_that_is_no_range_is_refused() -> None:
    (mistake,) = sheet("Name,Address,Scaling\na,D1,0.1\n").mistakes
    assert mistake.what == "0.1 is no scaling: write linear, or the factor into a column Scale"
    (mistake,) = sheet("Name,Address,Scaling\na,D1,Linear\n").mistakes
    assert mistake.what.startswith("a range needs its four ends")


def test_a_column_of_bits_belongs_to_the_address() -> None:
    found = sheet("Name,Address,Bit\na,D7,3\nb,D8,\nc,D9,x\n")
    assert [raw["address"] for raw in found.tags.values()][:2] == ["D7.3", "D8"]
    assert found.mistakes == [(4, "column C (Bit)", "x is no number of a bit")]


def test_names_become_names_of_keys_and_the_text_stays_as_description() -> None:
    found = sheet("Name,Address\nMotor 1: speed,D1\nHall/Pump#2,D2\nok,D3\n")
    assert list(found.tags) == ["Motor_1_speed", "Hall/Pump_2", "ok"]
    assert found.tags["Motor_1_speed"]["description"] == "Motor 1: speed"
    (note,) = found.notes
    assert note.startswith("names changed to what a key can have: Motor 1: speed -> Motor_1_speed,")


# ---- mistakes ------------------------------------------------------------------------------------


def test_every_mistake_has_its_row_and_column(tmp_path: Path) -> None:
    text = (
        "Name,Address,Type,Scale,R/W,Every,Min,Max\n"
        "a,D99999,int16,1,R,1s,,\n"
        "b,D1,int33,1,R,1s,,\n"
        "c,D2,int16,zero,maybe,500,,\n"
        "a,D3,int16,#REF!,R,1s,,\n"
        ",D4,int16,1,R,1s,,\n"
        "f,,int16,1,R,1s,,\n"
        "g,D5,int16,1,RW,1s,9,3\n"
        "h,M1,bool,2,R,1s,,\n"
    )
    found = mistakes(tmp_path, text)
    begins = [message.partition(": ")[2][:60] for message in found]
    for begin in (
        "row 2, column B (Address): ",
        "row 3, column C (Type): 'int33' is not a",
        "row 4, column D (Scale): 'zero' is no",
        "row 4, column E (R/W): 'maybe' is no acc",
        "row 4, column F (Every): 500 has",
        "row 5, column A (Name): a is in",
        "row 5, column D (Scale): #REF! is the er",
        "row 6: no name",
        "row 7: no address: fill it in, or begin ",
        "row 8, column E (R/W): min 9 is above ma",
        "row 9, column D (Scale): a bool has no s",
    ):
        assert any(one.startswith(begin) for one in begins), (begin, found)
    assert [int(one.split(" ")[1].rstrip(",:")) for one in begins] == sorted(
        int(one.split(" ")[1].rstrip(",:")) for one in begins
    )


def test_of_300_mistakes_of_one_kind_ten_are_shown_and_the_others_counted(tmp_path: Path) -> None:
    rows = "".join(f"t{number},D{number},x{number}\n" for number in range(300))
    found = mistakes(tmp_path, "Name,Address,Scale\n" + rows)
    assert len(found) == 11
    assert found[0] == "tags.csv: row 2, column C (Scale): 'x0' is no number"
    assert found[-1] == "tags.csv: row 12: 290 more like: 'x0' is no number"


def test_a_tag_of_the_file_and_of_its_sheet_cannot_have_one_name(tmp_path: Path) -> None:
    config = PLANT + "        tags: {a: {address: D9}}\n"
    (message,) = mistakes(tmp_path, "Name,Address\na,D1\n", config)
    assert message == "tags.csv: row 2, column A (Name): a is in `tags` of mixer already"


def test_a_missing_sheet_is_a_mistake_of_the_file(tmp_path: Path) -> None:
    config = PLANT.replace("tags.csv", "other.csv")
    (message,) = mistakes(tmp_path, "Name,Address\na,D1\n", config)
    assert "plant.yaml:10: lines.hall-1.devices.mixer.tags_from: " in message
    assert message.endswith("other.csv cannot be read: No such file or directory")


def test_no_file_of_the_gateway_overwrites_a_sheet(tmp_path: Path) -> None:
    config = PLANT.replace("{name: demo}", "{name: demo, state: tags.csv}")
    (message,) = mistakes(tmp_path, "Name,Address\na,D1\n", config)
    assert "tags.csv is a sheet of tags" in message


def test_history_in_a_sheet_needs_its_section(tmp_path: Path) -> None:
    (message,) = mistakes(tmp_path, "Name,Address,History\na,D1,yes\n")
    assert "the file has no `history:` section" in message
