"""Rows of `transfers:` in the file: their tags, what does not fit, and loops."""

from typing import Any

import pytest

from gateway.config import Config, ConfigErrors, built
from gateway.config.changes import needs_restart
from gateway.parts.transfers.forecast import forecasts, transfer_forecasts
from gateway.tags import Tag

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


@pytest.mark.parametrize("end", ["speed", "half", ":D10", ":D10..D12"])
def test_a_simulated_value_is_never_carried_to_a_real_device(end: str) -> None:
    device = {"protocol": "vigor", "station": 1, "tags": TAGS}
    lines = {
        "test": {"port": "simulator", "devices": {"a": device}},
        "hall": {"port": "/dev/ttyS0", "devices": {"b": device}},
    }
    source, target = (f"a{end}", f"b{end}") if end[0] == ":" else (f"a/{end}", "b/copy")
    with pytest.raises(ConfigErrors, match=f"{source} is simulated: its values are never written"):
        built({"lines": lines, "transfers": [row(source, target)]})
    assert built({"lines": lines, "transfers": [row("b/speed", "a/copy")]}).transfers


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


def test_a_row_that_repeats_another_one_is_refused() -> None:
    [message] = mistakes(row("a/speed", "b/copy"), row("a/speed", "b/copy", every="1s"))
    assert "row 1 carries a/speed to b/copy already" in message


def test_a_chain_is_no_loop() -> None:
    rows = row("a/speed", "b/copy"), row("b/copy", "a/limited"), row("a/limited", "b/word")
    assert len(config(*rows).transfers) == 3


def test_two_bits_of_a_word_are_no_loop() -> None:
    rows = row("a/bit", "b/bit"), row("b/other-bit", "a/other-bit")
    assert len(config(*rows).transfers) == 2


def tag_of(found: Config, key: str) -> Tag:
    [tag] = [one for device in found.devices for one in device.tags if one.key == key]
    return tag


def test_a_range_is_read_as_one_tag_and_written_as_another() -> None:
    found = config(
        row("a:D100..D109", "b:D200..D209"),
        row("a:D100..109", "b:D210..D219", every="300ms"),
        row("a:M0..M29", "b:M100..M129"),
        row("a:D100", "b/copy"),
        defaults={"every": "2s", "scale": 0.1, "write": True},
    )
    first, second, bits, one = found.transfers
    assert (first.source, first.target) == ("a/ranges/D100..D109", "b/ranges/to/D200..D209")
    assert first.text == ("a:D100..D109", "b:D200..D209")
    read = tag_of(found, first.source)
    assert (str(read.layout.type), read.every, read.shaping.scale, read.write) == (
        *("uint16[10]", 2.0, 1.0),
        None,
    )
    assert tag_of(found, second.source).every == 0.3
    assert str(tag_of(found, bits.source).layout.type) == "bool[30]"
    assert str(tag_of(found, one.source).layout.type) == "int16"  # as the tag at the other end
    _, b = found.devices
    assert [tag.name for tag in b.targets] == [
        *("ranges/to/D200..D209", "ranges/to/D210..D219"),
        "ranges/to/M100..M129",
    ]
    assert all(tag.write is not None for tag in b.targets)
    assert not {tag.key for tag in b.targets} & {tag.key for tag in b.tags}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (row("a:D0..D9", "b:D0..D8"), "a:D0..D9 has 10 elements, and b:D0..D8 has 9 elements"),
        (row("a:D0..D9", "b/copy"), "a:D0..D9 has 10 elements, and b/copy has one value"),
        (row("a:D0..D64", "b:D0..D64"), "D0..D64 has more than 64 addresses"),
        (row("a:D0..D9", "b:M0..M9"), "b:M0..M9 is bool[10], and a:D0..D9 is uint16[10]"),
        (row("a:D9..D0", "b:D0..D9"), "write the first and the last, such as D100..D119"),
        (row("a:D0..M9", "b:D0..D9"), "are of two kinds"),
        (row("c:D0..D9", "b:D0..D9"), "there is no device c: use a or b"),
        (row("a:Q0..Q9", "b:D0..D9"), "Q0"),
    ],
)
def test_a_mistake_in_a_range_says_what_would_be_right(wrong: Any, said: str) -> None:
    assert any(said in message for message in mistakes(wrong))


def test_a_range_that_cannot_be_written_is_no_target() -> None:
    line = {"port": "simulator", "devices": {"plc": {"protocol": "modbus-rtu", "station": 1}}}
    with pytest.raises(ConfigErrors, match="input:5 is read-only"):
        built({"lines": {"h": line}, "transfers": [row("plc:holding:0..9", "plc:input:5..14")]})


def test_a_loop_of_ranges_that_overlap_is_refused() -> None:
    rows = row("a:D100..D109", "b:D200..D209"), row("b:D209..D212", "a:D109..D112")
    [message] = mistakes(*rows)
    assert "a loop: row 1 (a:D100..D109 -> b:D200..D209), row 2" in message
    beside = row("a:D100..D109", "b:D200..D209"), row("b:D210..D212", "a:D109..D111")
    assert len(config(*beside).transfers) == 2


def test_the_name_of_a_range_is_reserved() -> None:
    tags = {"ranges/D0..D1": {"address": "D5"}}
    lines = {"h": {"port": "simulator", "devices": {"a": {"protocol": "vigor", "station": 1}}}}
    lines["h"]["devices"]["a"]["tags"] = tags  # type: ignore[index]  # plain data
    with pytest.raises(ConfigErrors, match="give that tag another name"):
        built({"lines": lines, "transfers": [row("a:D0..D1", "a:D10..D11")]})


def test_check_counts_the_writes_and_the_ages() -> None:
    rows = row("a/copy", "b/copy"), row("a:D100..D109", "b:D200..D209", every="500ms")
    whole = config(*rows)
    plain, found = forecasts(config())[0], forecasts(whole)
    first, second = transfer_forecasts(whole, found)
    assert (first.line, first.writes.often, second.writes.often) == ("hall", 1.0, 2.0)
    assert second.writes.seconds > first.writes.seconds > 0.01
    more = found[0].load - plain.load
    assert more > first.load + second.load  # the range is polled too
    assert first.worst_age is not None
    assert second.worst_age is not None
    assert first.worst_age > 1.0
    assert second.worst_age > 1.0


def test_a_reload_takes_over_other_rows() -> None:
    assert needs_restart(config(), config(row("a/speed", "b/copy"))) == []


def test_a_field_of_a_frame_is_carried_and_one_that_is_only_written_is_not() -> None:
    frames: dict[str, Any] = {"protocol": "frames", "framing": {"ending": "CR"}}
    weight = {"match": "(?P<weight>[0-9]+)", "fields": {"weight": {"type": "decimal"}}}
    put = {"send": "S={value}", "value": {"type": "decimal", "format": "06.2f"}, "match": "OK"}
    tags = {"weight": {"address": "weight"}, "limit": {"address": "limit", "write": True}}
    scale = frames | {"listen": {"w": weight}, "write": {"limit": put}, "tags": tags}
    line = {"port": "/dev/ttyS9", "devices": {"scale": scale}}
    plc = {"protocol": "vigor", "station": 1, "tags": TAGS}
    lines = {"a": line, "b": {"port": "/dev/ttyS8", "devices": {"plc": plc}}}
    rows = [row("scale/weight", "plc/copy"), row("plc/speed", "scale/limit")]
    assert len(built({"lines": lines, "transfers": rows}).transfers) == 2
    with pytest.raises(ConfigErrors, match="scale/limit can only be written"):
        built({"lines": lines, "transfers": [row("scale/limit", "plc/copy")]})


def test_nothing_is_carried_to_a_line_that_only_listens() -> None:
    device = {"protocol": "modbus-rtu", "station": 1}
    tags = {"n": {"address": "holding:1", "write": True}, "m": {"address": "holding:2"}}
    line = {"port": "/dev/ttyS9", "listen_only": True, "devices": {"plc": device | {"tags": tags}}}
    with pytest.raises(ConfigErrors, match="nothing is sent there"):
        built({"lines": {"hall": line}, "transfers": [row("plc/m", "plc/n")]})
