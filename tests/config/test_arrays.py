"""Arrays in the file: `type: uint16[50]`, and every setting that does not fit one."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.contract.meta import meta_fields
from gateway.protocols.driver import Span
from gateway.values import Kind, ValueType
from tests.config.test_config import M, on_mixer, tags

ONE = "give the element that needs it a tag of its own"
MISTAKES = [
    ("D1, type: 'uint16[500]'", ("type: a uint16[500] is 500 words, more than one request can "
     "carry: at most uint16[64]")),
    ("M0, type: 'bool[1500]'", ("type: a bool[1500] is 1500 bits, more than one request can carry: "
     "at most bool[1024]")),
    ("C200, type: 'int32[40]'", ("type: a int32[40] is 40 values of 32 bits, more than one request "
     "can carry: at most int32[32]")),
    ("D8190, type: 'int32[5]'", ("address: a int32[5] at D8190 takes 10 words, but the last is "
     "D8191")),
    ("D7.3, type: 'bool[2]'", "type: D7.3 is one bit of a word: it can only be bool"),
    ("D7, type: 'bool[2]'", ("type: D7 is a word: a bool[2] is an array of bits; for words write "
     "uint16[n]")),
    ("D7, type: 'int8[2]'", ("type: int8[2]: an array has whole words or bits: use uint16[n] or "
     "int16[n]")),
    ("D7, type: 'uint16[0]'", "type: uint16[0]: an array has 1 to 2000 elements"),
    ("M7, type: 'bool[2]', scale: 2", "scale: a bool[2] has no scale: only numbers have"),
    ("M7, type: 'bool[2]', alarm: {on: true}", f"alarm: a bool[2] has no alarm: {ONE}"),
    ("M7, type: 'bool[2]', debounce: 1s", f"debounce: a bool[2] has no debounce: {ONE}"),
    ("D7, type: 'int16[2]', alarm: {high: 2}", f"alarm: a int16[2] has no alarm: {ONE}"),
    ("D7, type: 'int16[2]', counter: true", f"counter: a int16[2] has no counter: {ONE}"),
    ("D7, type: 'int16[2]', enum: {0: off}", f"enum: a int16[2] has no enum: {ONE}"),
    ("D7, type: 'uint16[2]', write: {min: -1}", "write.min: -1 does not fit uint16 (0 to 65535)"),
]  # fmt: skip


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def mistakes(*rows: str) -> tuple[str, ...]:
    Path("plant.yaml").write_text(tags(*rows), encoding="utf-8")
    with pytest.raises(ConfigErrors) as caught:
        load("plant.yaml")
    return caught.value.messages


@pytest.mark.parametrize(("settings", "message"), MISTAKES)
def test_a_setting_that_does_not_fit_an_array_is_reported(settings: str, message: str) -> None:
    (found,) = mistakes(f"a: {{address: {settings}}}")
    assert found == f"plant.yaml:8: {M}.tags.a.{message}"


def test_an_array_is_no_input_of_a_formula() -> None:
    (found,) = mistakes("a: {address: D1, type: 'int16[2]'}", "b: {computed: a + 1}")
    assert found.endswith("mixer/a is an array: only single numbers and bits can be calculated")


def test_arrays_that_overlap_are_read_together() -> None:
    (found,) = mistakes(
        "a: {address: D0, type: 'int16[64]'}", "b: {address: D40, type: 'int16[64]'}"
    )
    assert found == (
        f"plant.yaml:9: {M}.tags.b.address: D0 to D40 overlap, and together they are 104 "
        "addresses, more than one request can carry: make them shorter"
    )


def test_an_array_has_one_span_and_says_its_length() -> None:
    text = tags(
        "a: {address: D0, type: 'float32[8]', scale: 0.1, deadband: 2, write: true}",
        "b: {address: M10, type: 'bool[30]'}",
        "c: {address: D3, alarm: {high: 10}}",
    )
    Path("plant.yaml").write_text(text, encoding="utf-8")
    a, b, c = load("plant.yaml").devices[0].tags
    assert (a.span, b.span) == (Span("D", 0, 16), Span("M", 10, 30))
    assert a.layout.type == ValueType(Kind.FLOAT32, count=8)
    fields = meta_fields(a)
    assert (fields["type"], fields["raw_type"]) == ("float64[8]", "float32[8]")
    assert (fields["length"], meta_fields(c)["length"]) == (8, None)


def test_a_setting_of_the_device_that_fits_no_array_is_left_out() -> None:
    text = on_mixer(
        "protocol: vigor\ndefaults: {debounce: 2s, scale: 2, deadband: 1}\n"
        "tags: {a: {address: M0, type: 'bool[3]'}}\n"
    )
    Path("plant.yaml").write_text(text, encoding="utf-8")
    (tag,) = load("plant.yaml").devices[0].tags
    assert (tag.origin.kept, tag.publishing.deadband, tag.shaping.scale) == (None, None, 1.0)
