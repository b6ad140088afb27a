"""Settings that shape values: what a read shows and a write sends, and every wrong combination."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from gateway.config import ConfigErrors, load
from gateway.contract.meta import meta_fields
from gateway.errors import BadValue
from gateway.tags import Tag
from gateway.values import Value
from tests.config.test_config import M, tags


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def tags_of(*rows: str) -> Sequence[Tag]:
    Path("plant.yaml").write_text(tags(*rows), encoding="utf-8")
    return load("plant.yaml").devices[0].tags


def only(settings: str) -> Tag:
    (tag,) = tags_of(f"t: {{address: D1, write: true, {settings}}}")
    return tag


def float_words(value: float) -> list[int]:
    high, low = struct.unpack(">2H", struct.pack(">f", value))
    return [low, high]


LEVEL = "from: [4000, 20000], to: [0, 100]"
THIRDS = "from: [0, 3], to: [0, 1]"
MODE = "enum: {0: off, 1: auto, 2: manual}"

READS: list[tuple[str, list[int], Value | None]] = [
    ("decimals: 1, scale: 0.01", [1234], 12.3),
    ("decimals: 1, scale: 0.01", [0xFFFF], 0.0),  # and not -0.0
    ("decimals: 2, type: float32", float_words(235.388), 235.39),
    ("type: float32", float_words(235.388), 235.388),
    ("type: float32", float_words(16777220.0), 16777220.0),
    ("type: float32", float_words(1234567936.0), 1234568000.0),
    ("type: float32, scale: 0.1", float_words(2353.88), 235.388),
    ("type: float32, offset: -1000", float_words(1000.1), 0.1),
    (LEVEL, [4000], 0.0),
    (LEVEL, [12000], 50.0),
    (LEVEL, [3200], -5.0),  # below the range the line goes on
    (THIRDS, [1], 1 / 3),
    (THIRDS, [3], 1.0),
    ("from: [0, 1000], to: [100, 0]", [250], 75.0),
    ("from: [4, 20], to: [0, 100], type: float32", float_words(12.8), 55.0),
    (f"{LEVEL}, clamp: [0, 100]", [3200], 0.0),
    (f"{LEVEL}, clamp: [0, 100]", [20001], 100.0),
    (f"{LEVEL}, clamp: [null, 100]", [3200], -5.0),
    ("clamp: [0, null]", [0xFFFF], 0),
    (MODE, [1], 1),
    (MODE, [7], 7),  # no name, and yet what the device holds
    ("type: uint8", [0x12FE], 0xFE),
    ("type: uint8, byte: high", [0x12FE], 0x12),
    ("type: int8", [0x12FE], -2),
    ("type: int8, byte: high, scale: 0.5", [0xFF00], -0.5),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "words", "value"), READS)
def test_a_read_shows_the_shaped_value(
    settings: str, words: list[int], value: Value | None
) -> None:
    read = only(settings).decode(words)
    assert read == value
    assert type(read) is type(value)
    assert str(read) == str(value)


WRITES: list[tuple[str, Value, list[int], Value]] = [
    ("decimals: 1, scale: 0.01", 12.34, [1230], 12.3),
    ("decimals: 2, type: float32", 235.3879, float_words(235.39), 235.39),
    (LEVEL, 50, [12000], 50.0),
    (LEVEL, 33.333, [9333], 33.33125),  # the next step of the device
    (THIRDS, 1, [3], 1.0),
    ("from: [4, 20], to: [0, 100], type: float32", 55, float_words(12.8), 55.0),
    (f"{LEVEL}, clamp: [0, 100]", 100, [20000], 100.0),
    (MODE, 2, [2], 2),
    (MODE, "manual", [2], 2),
    (MODE, 0.0, [0], 0),
    ("type: uint8", 0xFE, [0xFE], 0xFE),
    ("type: uint8, byte: high", 0x12, [0x12], 0x12),
    ("type: int8, byte: high", -2, [0xFE], -2),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "value", "units", "held"), WRITES)
def test_a_write_sends_the_inverse_and_names_what_the_device_holds(
    settings: str, value: Value, units: list[int], held: Value
) -> None:
    tag = only(settings)
    assert tag.encode(value) == units
    assert tag.from_units(units) == held


REFUSED: list[tuple[str, Value, str]] = [
    (MODE, 7, "7 has no name: use 0 (off), 1 (auto), 2 (manual)"),
    (MODE, "Auto", "'Auto' is no name of a value: use 0 (off), 1 (auto), 2 (manual)"),
    (f"{LEVEL}, clamp: [0, 100]", 101, "101 is outside the clamp: 0 to 100"),
    ("type: int8", 128, "128 does not fit int8 (-128 to 127)"),
    ("type: uint8, byte: high", -1, "-1 does not fit uint8 (0 to 255)"),
    ("type: uint8", "A", "'A' is not a number"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "value", "why"), REFUSED)
def test_a_write_that_no_read_could_show_is_refused(settings: str, value: Value, why: str) -> None:
    tag = only(settings)
    with pytest.raises(BadValue) as caught:
        tag.encode(value)
    assert str(caught.value) == why


@pytest.mark.parametrize(
    ("settings", "greatest", "value", "why"),
    [
        ("scale: 0.01, decimals: 1", 9.97, 9.96, "9.96 (rounded to 10.0)"),
        ("from: [0, 2], to: [0, 5], clamp: [0, 4]", 4, 4, "4 (the device holds 5.0)"),
    ],
)
def test_rounding_and_clamp_do_not_get_around_the_limits_of_a_write(
    settings: str, greatest: float, value: float, why: str
) -> None:
    text = tags(f"t: {{address: D1, {settings}}}")
    rule = f"    defaults: {{write: {{max: {greatest}}}}}\n    devices:\n"
    Path("plant.yaml").write_text(text.replace("    devices:\n", rule, 1))
    (tag,) = load("plant.yaml").devices[0].tags
    with pytest.raises(BadValue) as caught:
        tag.encode(value)
    assert str(caught.value) == f"{why} is above the greatest value {greatest}"


def test_an_inverted_bit_is_read_and_written_the_other_way_round() -> None:
    (coil, bit) = tags_of(
        "coil: {address: M1, invert: true, write: true}",
        "bit: {address: D1.3, invert: true, write: true, enum: {0: closed, 1: open}}",
    )
    assert (coil.decode([1]), coil.decode([0])) == (False, True)
    assert (coil.encode(value=True), coil.from_units([0])) == ([0], True)
    assert (bit.decode([0b1000]), bit.decode([0b0111])) == (False, True)
    assert (bit.encode("open"), bit.from_units([0])) == ([0], True)
    with pytest.raises(BadValue):
        coil.encode(2)


def test_a_write_of_a_part_keeps_the_rest_of_the_word() -> None:
    bit = tags_of("t: {address: D1.3, write: true}")[0].part
    high = only("type: uint8, byte: high").part
    assert bit is not None
    assert high is not None
    assert (bit.into(0xFFFF, 0), bit.into(0, 1), bit.of(0b1000)) == (0xFFF7, 0b1000, 1)
    assert (high.into(0x12FE, 0xAB), high.of(0x12FE)) == (0xABFE, 0x12)


def test_bits_of_a_word_are_tags_of_one_address() -> None:
    pump, fault = tags_of(
        "status: {address: D2, every: 2s, bits: {0: pump, 3: {name: fault, invert: true}}}"
    )
    assert (pump.name, pump.text, pump.every) == ("status/pump", "D2.0", 2.0)
    assert (fault.name, fault.text, fault.every) == ("status/fault", "D2.3", 2.0)
    assert pump.span == fault.span
    assert (pump.decode([0b1000]), fault.decode([0b1000])) == (False, False)
    assert (pump.decode([0b0001]), fault.decode([0b0001])) == (True, True)


def test_a_default_that_does_not_suit_a_tag_is_ignored() -> None:
    text = tags("n: {address: D1}", "m: {address: D2, scale: 0.1}", "b: {address: M1}")
    begin = "    defaults: {decimals: 0, clamp: [0, 9.5], from: [0, 1], to: [0, 2]}\n"
    Path("plant.yaml").write_text(text.replace("    devices:\n", f"{begin}    devices:\n", 1))
    n, m, b = load("plant.yaml").devices[0].tags
    assert (n.decode([3]), m.decode([12]), b.decode([1])) == (6, 1.0, True)


@pytest.mark.parametrize(
    ("settings", "of_value", "raw"),
    [
        ("scale: 0.1", "float64", "int16"),
        ("scale: 10", "int32", "int16"),
        ("scale: 10, type: uint64", "float64", "uint64"),
        ("type: bcd16", "uint16", "bcd16"),
        ("type: float32", "float32", "float32"),
        ("type: float32, scale: 2", "float64", "float32"),
        (LEVEL, "float64", "int16"),
        (MODE, "int16", "int16"),
        ("type: uint8", "uint8", "uint8"),
        ('type: "string[4]"', "string[4]", "string[4]"),
    ],
)
def test_meta_tells_the_type_of_the_value_and_that_of_the_device(
    settings: str, of_value: str, raw: str
) -> None:
    described = meta_fields(only(settings))
    assert (described["type"], described["raw_type"]) == (of_value, raw)


def test_meta_has_the_shaping() -> None:
    shaping = f"{LEVEL}, decimals: 1, clamp: [0, 100], range: [-1.25, null]"
    described: dict[str, Any] = meta_fields(only(shaping))
    assert described["from"] == (4000, 20000)
    assert described["to"] == (0, 100)
    assert described["decimals"] == 1
    assert described["clamp"] == {"min": 0, "max": 100}
    assert described["range"] == {"min": -1.25, "max": None}
    assert meta_fields(only(MODE))["enum"] == {"0": "off", "1": "auto", "2": "manual"}


WHOLE = "the values are whole numbers (int16)"
MISTAKES = [
    ("D1, enum: {0: off, 1: true}", "enum: 1: true is no name: write a word, true in quotes"),
    ("D1, enum: {0: off, 70000: x}", "enum: 70000 is no value of a int16"),
    ("D1, enum: {off: 0}", "enum: 'off' is no whole number: write {0: off, 1: auto}"),
    ("D1, enum: {0: off, 1: off}",
     "enum: off is there twice: a write of the name would not be clear"),
    ("D1, enum: [off, auto]", "enum: a list: write numbers with names, such as {0: off, 1: auto}"),
    ("D1, enum: {0: off}, scale: 0.1",
     "enum: an enum names the numbers of the device: remove scale, offset, from and to"),
    ("D1, enum: {0: off}, deadband: 1",
     "enum: a value with names has no deadband: each change is another state"),
    ("D1, enum: {0: off}, clamp: [0, 1]",
     "enum: a value with names has no clamp: it would show another state"),
    ("D1, type: float32, enum: {0: off}",
     "enum: a float32 has no enum: only bits and whole numbers have"),
    ("M1, enum: {2: off}", "enum: 2 is no value of a bool"),
    ("D1, bits: {16: pump}",
     "bits: '16' is no bit of a word: they have the numbers 0 to 15"),
    ("M1, bits: {0: pump}", "bits: M1 is no word of 16 bits: remove bits"),
    ("D1.1, bits: {0: pump}", "bits: D1.1 is no word of 16 bits: remove bits"),
    ("D1, bits: {0: pump}, scale: 2", "scale: a bool has no scale: only numbers have"),
    ("D1, byte: high", "byte: a int16 has whole words: byte needs type: uint8 or int8"),
    ("D1, type: uint8, byte: middle",
     "byte: 'middle' is no byte of a word: use low or high"),
    ("D1, type: uint8, byte_order: low_first",
     "byte_order: D1 is one byte: write byte: low or byte: high"),
    ("D1, from: [4, 20]", "from and to belong together: from: [4, 20] and to: [0, 100]"),
    ("D1, from: [4, 4], to: [0, 1]",
     "from: 4 twice: the two ends must differ, such as [4, 20]"),
    ("D1, from: [4, 20], to: [0, 1], offset: 2",
     "from and to replace scale and offset: remove offset"),
    ("D1, clamp: [0.5, 7]", "clamp: 0.5 is no limit here: the values are whole numbers"),
    ("D1, scale: 0.01, decimals: 1, clamp: [0.25, 7]",
     "clamp: 0.25 is no limit here: the values have 1 decimals"),
    ("D1, clamp: [7, 0]", "clamp: 7 is not below 0: write [0, 100]"),
    ("D1, range: [20, 4]", "range: 20 is not below 4: write [0, 100]"),
    ("D1, range: 4..20",
     "range: '4..20': write the least and the greatest value, such as [0, 100] or [0, null]"),
    ("D1, range: [null, null]",
     "range: write a least or a greatest value, such as [0, null]"),
    ("M1, range: [0, 1]", "range: a bool has no range: only numbers have"),
    ('D1, type: "string[4]", range: [0, 1]',
     "range: a string[4] has no range: only numbers have"),
    ("D1, counter: true, range: [0, 1]", "range: a total has no range: no sensor measures it"),
    ("D1, clamp: 7",
     "clamp: 7: write the least and the greatest value, such as [0, 100] or [0, null]"),
    ("D1, decimals: 1",
     f"decimals: {WHOLE}: if 123 in the device is 12.3, write scale: 0.1"),
    ("M1, decimals: 1", "decimals: a bool has no decimals: only numbers have"),
    ("D1, invert: true",
     "invert: a int16 cannot be inverted: only a bit can; for numbers use scale: -1"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "says"), MISTAKES)
def test_a_wrong_combination_is_a_mistake_that_says_what_is_right(settings: str, says: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        tags_of(f"t: {{address: {settings}}}")
    setting, _, rest = says.partition(": ")
    place = f"{M}.tags.t" if " " in setting else f"{M}.tags.t.{setting}"
    what = says if " " in setting else rest
    assert caught.value.messages == (f"plant.yaml:8: {place}: {what}",)
