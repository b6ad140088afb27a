"""The `peek` command: every type and word order of a range."""

import struct
from pathlib import Path

import pytest
from rich.console import Console

from gateway.cli.line.peek import one_device, view_of
from gateway.cli.line.peek_table import MEDIUM, WIDE, Cell, change_text, number_text, table_of
from gateway.config import ConfigErrors
from gateway.errors import ConfigError
from gateway.protocols.driver import Unit
from gateway.protocols.ranges import addresses
from gateway.protocols.vigor import Vigor
from gateway.tags import Reason, bad, good
from gateway.values import Order
from tests.conftest import Command
from tests.e2e.processes import plc_gateway

OPTIONS = {"port": "simulator", "protocol": "vigor", "station": 1, "baudrate": None, "format": None}


def shown(cells: list[Cell], unit: Unit = Unit.WORD, width: int = 200) -> list[list[str]]:
    console = Console(width=200, force_terminal=False)
    with console.capture() as capture:
        console.print(table_of(cells, unit, Order.HIGH_FIRST, width))
    return [line.split() for line in capture.get().splitlines()]


def words(value: float) -> tuple[int, int]:
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return high, low


def test_a_float_shows_in_the_column_of_its_word_order() -> None:
    high, low = words(21.5)
    head, first, second = shown([Cell("D10", high), Cell("D11", low)])
    assert head[:4] == ["address", "hex", "bits", "15..0"]
    assert first[0] == "D10"
    assert first[1] == f"{high:04X}"
    assert first[-1] == "21.5"  # high float32
    assert first[6] == str(high)
    assert second[-1] == "-"  # no word behind the last
    _, first, _ = shown([Cell("D10", low), Cell("D11", high)])
    assert "21.5" in first[:-1]
    assert first[-1] != "21.5"


def test_a_word_shows_its_bits_signs_and_letters() -> None:
    _, row = shown([Cell("D1", 0xFF41)])
    assert row[1:9] == ["FF41", "1111", "1111", "0100", "0001", "65345", "-191", ".A"]


def test_narrow_terminals_lose_columns_not_rows() -> None:
    cells = [Cell("D1", 1), Cell("D2", 2)]
    wide, medium, narrow = (shown(cells, width=width)[0] for width in (WIDE, MEDIUM, 80))
    assert "bits" in wide
    assert wide.count("uint32") == 2
    assert "bits" in medium
    assert "uint32" not in medium
    assert "bits" not in narrow
    assert narrow.count("float32") == 2


def test_an_unlikely_float_has_a_question_mark() -> None:
    assert [number_text(value) for value in (0.0, 21.5, 1e-40, 3e30, None, 7)] == [
        *("0", "21.5", "1e-40?", "3e+30?", "-", "7")
    ]


def test_bits_are_shown_in_eights_and_counters_as_32_bits() -> None:
    head, first, second = shown([Cell(f"M{n}", n % 2) for n in range(10)], Unit.BIT)
    assert (head[1], head[-1]) == ("+0", "+7")
    assert first == ["M0", *("0", "1") * 4]
    assert second == ["M8", "0", "1"]
    _, row = shown([Cell("C200", 0xFFFFFFFE)], Unit.DWORD)
    assert row[:4] == ["C200", "FFFFFFFE", "4294967294", "-2"]


def test_a_value_that_is_not_known_says_why() -> None:
    _, first, _ = shown([Cell("D1", None, note="bad: refused"), Cell("D2", 5)])
    assert first[-2:] == ["bad:", "refused"]
    assert set(first[1:-2]) == {"-"}


def test_a_change_is_marked_with_a_star_and_told_in_a_line() -> None:
    _, row = shown([Cell("D1", 5, changed=True, note="mixer/speed")])
    assert row[-2:] == ["*", "mixer/speed"]
    assert change_text(Cell("D1", 5), 4, Unit.WORD) == "D1: 4 (0x0004) -> 5 (0x0005)"
    assert change_text(Cell("D1", None, note="bad: no-reply"), 4, Unit.WORD) == (
        "D1: 4 (0x0004) -> bad: no-reply"
    )


def test_a_bad_value_is_never_shown_as_the_last_good_one() -> None:
    view = view_of(one_device(OPTIONS, []), "D1")
    (tag,) = view.tags
    view.samples([good(tag, 5, 1)])
    assert view.cell(tag).raw == 5
    view.samples([bad(tag, Reason.NO_REPLY, 2)])
    assert view.cell(tag) == Cell("D1", None, True, "bad: no-reply")
    first, second = view.changes()
    assert first == "D1: 5 (0x0005)"
    assert second == "D1: 5 (0x0005) -> bad: no-reply"
    assert not list(view.changes())


@pytest.mark.parametrize(
    ("text", "area", "numbers"),
    [
        ("D100..D119", "D", range(100, 120)),
        ("D100..119", "D", range(100, 120)),
        ("D7", "D", range(7, 8)),
        ("X0..X17", "X", range(16)),
    ],
)
def test_a_range_is_written_as_the_maker_writes_addresses(
    text: str, area: str, numbers: range
) -> None:
    assert addresses(Vigor(station=1), text, 1000) == (area, numbers)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("D119..D100", "is no range"),
        ("D1..M5", "of two kinds"),
        ("C199..C200", "of two kinds"),
        ("D7.3", "without a bit"),
        ("D0..D2000", "more than 1000"),
        ("Q5", "Q5"),
    ],
)
def test_a_wrong_range_is_explained(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        addresses(Vigor(station=1), text, 1000)


def test_options_describe_the_device_as_the_file_would() -> None:
    options = {**OPTIONS, "protocol": "modbus-rtu"}
    view = view_of(one_device(options, ["addressing=k120s"]), "D0100..D0103")
    assert [tag.text for tag in view.tags] == ["D0100", "D0101", "D0102", "D0103"]
    with pytest.raises(ConfigErrors, match=r"addresing: no setting .* did you mean addressing"):
        one_device(options, ["addresing=k120s"])
    with pytest.raises(ConfigError, match="write NAME=VALUE"):
        one_device(options, ["addressing"])
    with pytest.raises(ConfigError, match="--port is missing"):
        one_device({**options, "port": None}, [])


def test_a_range_of_a_device_in_a_file_shows_its_tags(config: Path) -> None:
    done = plc_gateway("peek", config, "mixer", "D9..D11")
    assert done.code == 0
    rows = [line.split() for line in done.out.splitlines()]
    assert [row[0] for row in rows] == ["address", "D9", "D10", "D11"]
    assert rows[2][-1] == "speed"
    assert int(rows[2][1], 16) == int(rows[2][6])


def test_mistakes_of_the_command_end_with_2(command: Command, config: Path) -> None:
    for arguments, problem in (
        (["D1", "D2"], "write a RANGE such as D100..D119, or CONFIG DEVICE RANGE"),
        ([config, "oven", "D1"], "there is no device oven: the file has mixer"),
        ([config, "mixer", "D1", "--port", "simulator"], "leave out --port"),
        (["D1"], "--port is missing"),
    ):
        done = command("peek", *arguments)
        assert (done.code, problem in done.err) == (2, True), done
