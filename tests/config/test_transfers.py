"""Rows of `transfers:` in the file: their tags, what does not fit, and loops."""

from typing import Any

import pytest

from gateway.config import Config, ConfigErrors, built
from gateway.config.changes import needs_restart

TAGS: dict[str, Any] = {
    "speed": {"address": "D10", "every": "2s"},
    "copy": {"address": "D11", "write": True},
    "wide": {"address": "D10", "type": "int32", "write": True},
    "half": {"computed": "speed / 2"},
    "bit": {"address": "D20.3", "write": True},
    "other-bit": {"address": "D20.4", "write": True},
    "word": {"address": "D20", "write": True},
    "limited": {"address": "D30", "write": {"min": 0, "max": 10}},
    "name": {"address": "D40", "type": "string[4]", "write": True},
}


def config(*rows: Any, **sections: Any) -> Config:
    device = {"protocol": "vigor", "station": 1, "tags": TAGS}
    lines = {"hall": {"port": "simulator", "devices": {"a": device, "b": device | {"station": 2}}}}
    return built({"lines": lines, "transfers": list(rows), **sections})


def mistakes(*rows: Any) -> list[str]:
    with pytest.raises(ConfigErrors) as caught:
        config(*rows)
    return str(caught.value).splitlines()


def row(source: str, target: str, **settings: Any) -> dict[str, Any]:
    return {"from": source, "to": target, **settings}


def test_a_row_has_its_settings_or_defaults() -> None:
    first, second = config(
        row("a/speed", "b/copy"),
        row("a/half", "b/limited", every="1s", scale=0.1, stale="1min", if_stale={"write": 3}),
    ).transfers
    assert (first.number, first.source, first.target) == (1, "a/speed", "b/copy")
    assert (first.every, first.stale, first.substitute) == (None, 6.0, None)
    assert (second.every, second.stale, second.substitute) == (1.0, 60.0, 3)
    assert (first.when, second.when) == ("on change", "every 1 s")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (row("a/sped", "b/copy"), "there is no tag a/sped: did you mean a/speed?"),
        (row("x/speed", "b/copy"), "there is no tag x/speed: did you mean"),
        (row("a/speed", "b/speed"), "b/speed may only be read: write `write: true` at that tag"),
        (row("a/speed", "b/half"), "b/half is computed from other tags"),
        (row("a/speed", "b/bit"), "b/bit is bool, and a/speed is int16: a number is carried to"),
        (row("a/name", "b/copy"), "a text is carried to a text only"),
        (row("a/bit", "b/bit", scale=2), "a/bit is a bit: only a number has a scale"),
        (row("a/speed", "b/copy", stale="2s"), "always be too old; write stale: 6s"),
        (row("a/speed", "b/limited", if_stale={"write": 20}), "20 is above the greatest value 10"),
        (row("a/speed", "b/copy", if_stale="zero"), "write skip, or {write: 0}"),
        (row("a/speed", "b/copy", every="1s", on="change"), "exclude each other"),
        (row("a/speed", "b/copy", evry="1s"), "did you mean every?"),
        ({"from": "a/speed"}, "missing: a transfer needs it"),
        ("a/speed", "stands where settings are expected"),
    ],
)
def test_a_mistake_says_what_would_be_right(wrong: Any, said: str) -> None:
    [message] = mistakes(wrong)
    assert said in message


@pytest.mark.parametrize(
    ("rows", "loop"),
    [
        ([row("a/copy", "a/copy")], "row 1 (a/copy -> a/copy)"),
        ([row("a/speed", "b/copy"), row("b/copy", "a/wide")], "row 1"),  # D10 is a part of wide
        ([row("a/half", "b/copy"), row("b/copy", "a/wide")], "row 1"),  # through a computed tag
        (
            [row("a/copy", "b/copy"), row("a/speed", "b/limited"), row("b/copy", "a/copy")],
            "row 1 (a/copy -> b/copy), row 3 (b/copy -> a/copy)",
        ),
        ([row("a/bit", "b/bit"), row("b/word", "a/word")], "row 1"),
    ],
)
def test_a_loop_is_refused_with_its_rows(rows: list[Any], loop: str) -> None:
    [message] = mistakes(*rows)
    assert f"a loop: {loop}" in message


def test_a_chain_is_no_loop() -> None:
    rows = row("a/speed", "b/copy"), row("b/copy", "a/limited"), row("a/limited", "b/word")
    assert len(config(*rows).transfers) == 3


def test_two_bits_of_a_word_are_no_loop() -> None:
    rows = row("a/bit", "b/bit"), row("b/other-bit", "a/other-bit")
    assert len(config(*rows).transfers) == 2


def test_a_reload_takes_over_other_rows() -> None:
    assert needs_restart(config(), config(row("a/speed", "b/copy"))) == []


def test_nothing_is_carried_to_a_line_that_only_listens() -> None:
    device = {"protocol": "modbus-rtu", "station": 1}
    tags = {"n": {"address": "holding:1", "write": True}, "m": {"address": "holding:2"}}
    line = {"port": "/dev/ttyS9", "listen_only": True, "devices": {"plc": device | {"tags": tags}}}
    with pytest.raises(ConfigErrors, match="nothing is sent there"):
        built({"lines": {"hall": line}, "transfers": [row("plc/m", "plc/n")]})
