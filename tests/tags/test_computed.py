"""Computed tags: arithmetic, quality, time, and when they are calculated."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.config.tags.formulas import parse
from gateway.tags import Quality, Reason, Sample, Tag, bad, good
from gateway.tags.formula import Formula
from gateway.tags.mirror import Mirror
from gateway.values import Value
from gateway.values.numerals import Scalar
from tests.config.test_config import M, tags

FORMULAS: list[tuple[str, Scalar, Scalar, Scalar]] = [
    ("a + b", 0.1, 0.2, 0.3),  # and not 0.30000000000000004
    ("a - b * 2", 10, 3, 4),
    ("(a - b) * 2", 10, 3, 14),
    ("a / b", 1, 4, 0.25),
    ("a / b", 6, 3, 2.0),
    ("-a + b", 1, 3, 2),
    ("a - -b", 1, 3, 4),
    ("a + b", True, True, 2),
    ("max(a, b, 7) - min(a, b)", 1, 5, 6),
    ("abs(a - b)", 1, 3, 2),
    ("a * b", 2**62, 3, 3 * 2**62),
    ("a + 9007199254740993 - b", 0, 0, 2**53 + 1),
    ("a + b * 0.1", 1, 3, 1.3),
]


def formula(text: str) -> tuple[Formula, list[str]]:
    parsed = parse(text)
    return Formula(text, parsed.term, parsed.whole), parsed.names


@pytest.mark.parametrize(("text", "a", "b", "result"), FORMULAS)
def test_a_formula_calculates_with_decimals(
    text: str, a: Scalar, b: Scalar, result: Scalar
) -> None:
    made, names = formula(text)
    if any(isinstance(value, float) for value in (a, b)):
        made = Formula(text, made.term, whole=False)
    found = made.value([{"a": a, "b": b}[name] for name in names])
    assert (found, type(found)) == (result, type(result))


@pytest.mark.parametrize("text", ["a / b", "b / b", "1 / (a - a)"])
def test_a_division_by_zero_has_no_result(text: str) -> None:
    made, names = formula(text)
    with pytest.raises(ArithmeticError, match=r"^division by zero$"):
        made.value([{"a": 1, "b": 0}[name] for name in names])


def test_a_result_beyond_64_bits_has_no_result() -> None:
    made, _ = formula("a * a")
    with pytest.raises(ArithmeticError, match=r"^the result is too large$"):
        made.value([2**40])


def test_the_deepest_formula_is_calculated() -> None:
    depth = 99
    made, _ = formula("-(" * depth + "a" + ")" * depth)
    assert made.value([1]) == -1


MISTAKES = [
    ("n +", "'n +': it ends too early"),
    ("(n", "'(n': it ends too early"),
    ("n ** 2", "'n ** 2': '* 2' cannot stand here"),
    ("n, 2", "'n, 2': ', 2' cannot stand here"),
    ("abs(n, 2)", "'abs(n, 2)': ', 2)' cannot stand here"),
    ("n.real if n else 2", "'n.real if n else 2': 'if n else 2' cannot stand here"),
    ("open(n)", "'open(n)': '(n)' cannot stand here"),
    ("x + n", "x is no tag of mixer: one of another device is written 'device/tag'"),
    ("flwo + n", "flwo is no tag of mixer: did you mean flow?"),
    ("text + n", "mixer/text is a text: only numbers and bits can be calculated"),
    ("1 + 1", "'1 + 1' names no tag: its value never changes"),
    ("t + n", "a loop: mixer/t -> mixer/t: a value cannot follow from itself"),
    ("u + n", "a loop: mixer/t -> mixer/u -> mixer/t: a value cannot follow from itself"),
    ("+".join(["n"] * 151), "301 characters: a formula has at most 300; use two tags"),
]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def tags_of(*rows: str) -> dict[str, Tag]:
    Path("plant.yaml").write_text(tags(*rows), encoding="utf-8")
    return {tag.name: tag for tag in load("plant.yaml").devices[0].tags}


@pytest.mark.parametrize(("text", "says"), MISTAKES)
def test_a_wrong_formula_is_a_mistake_of_the_file(text: str, says: str) -> None:
    rows = ["n: {address: D1}", "flow: {address: D2}", 'text: {address: D3, type: "string[2]"}']
    with pytest.raises(ConfigErrors) as caught:
        tags_of(*rows, f't: {{computed: "{text}"}}', 'u: {computed: "t"}')
    # A loop is found once, at the tag that closes it.
    (message,) = caught.value.messages
    place = f"plant.yaml:{12 if text == 'u + n' else 11}: {M}.tags."
    assert message.startswith(place)
    assert f".computed: {says}" in message


def test_a_computed_tag_has_no_settings_of_reading_and_writing() -> None:
    with pytest.raises(ConfigErrors) as caught:
        tags_of("n: {address: D1}", "t: {computed: n, write: true}")
    assert "write: no setting of a computed tag: use computed, unit" in str(caught.value)


ROWS = (
    "a: {address: D1}",
    "b: {address: D2, deadband: 5}",
    'total: {computed: "a + b"}',
    'share: {computed: "a / total * 100", decimals: 1}',
)


def values(samples: list[Sample]) -> dict[str, Value | None]:
    return {sample.tag.name: sample.value for sample in samples}


def test_a_computed_value_follows_its_inputs_and_is_as_new_as_the_newest() -> None:
    tag = tags_of(*ROWS)
    mirror = Mirror(tag.values(), 0)
    assert mirror[tag["share"]].reason is Reason.STARTING
    changed = mirror.update([good(tag["a"], 30, 1000), good(tag["b"], 70, 2000)])
    found = mirror.follow(changed)
    assert values(found) == {"a": 30, "b": 70, "total": 100, "share": 30.0}
    assert {sample.time for sample in found[2:]} == {2000}
    assert mirror.follow(mirror.update([good(tag["a"], 30, 3000)])) == []
    assert mirror[tag["total"]].time == 3000  # read again: still 100


def test_a_bad_input_makes_it_bad_and_is_named() -> None:
    tag = tags_of(*ROWS)
    mirror = Mirror(tag.values(), 0)
    mirror.follow(mirror.update([good(tag["a"], 30, 1000), good(tag["b"], 70, 1000)]))
    lost = bad(tag["b"], Reason.NO_REPLY, 2000, "No byte came back")
    _, total, share = mirror.follow(mirror.update([lost]))
    assert total == bad(tag["total"], Reason.NO_REPLY, 2000, "input b is bad: No byte came back")
    assert (share.quality, share.reason) == (Quality.BAD, Reason.NO_REPLY)
    assert share.detail == "input total is bad: input b is bad: No byte came back"


def test_a_division_by_zero_is_bad_until_the_divisor_changes() -> None:
    tag = tags_of(*ROWS)
    mirror = Mirror(tag.values(), 0)
    found = mirror.follow(mirror.update([good(tag["a"], 5, 1000), good(tag["b"], -5, 1000)]))
    assert found[3] == bad(tag["share"], Reason.NOT_A_NUMBER, 1000, "division by zero")
    assert mirror.follow(mirror.update([good(tag["b"], -5, 2000)])) == []
    assert mirror[tag["share"]].time == 1000  # when it became bad
    found = mirror.follow(mirror.update([good(tag["b"], 5, 3000)]))
    assert values(found) == {"b": 5, "total": 10, "share": 50.0}


def test_the_type_of_a_computed_value_follows_from_its_inputs() -> None:
    tag = tags_of(
        "a: {address: D1}", "b: {address: D2, scale: 0.1}", "on: {address: M1}",
        "whole: {computed: a * 2 + on}", "half: {computed: a / 2}", "of_b: {computed: a + b}",
    )  # fmt: skip
    assert [tag[name].value_type for name in ("whole", "half", "of_b")] == [
        "int64", "float64", "float64",
    ]  # fmt: skip
