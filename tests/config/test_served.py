"""Mistakes in served lines, each with its place and the correct form."""

from typing import Any

import pytest

from gateway.config import ConfigErrors, built

HALL = {
    "port": "/dev/ttyS1",
    "devices": {
        "mixer": {
            "protocol": "vigor",
            "station": 1,
            "tags": {"speed": {"address": "D0"}, "run": {"address": "M0"}},
        }
    },
}


def mistakes(tags: dict[str, Any], *, line: Any = None, top: Any = None, **device: Any) -> str:
    hmi = {"protocol": "modbus-tcp", "tags": tags, **device}
    panel = {"port": "tcp://127.0.0.1:502", "serve": True, "devices": {"hmi": hmi}, **(line or {})}
    with pytest.raises(ConfigErrors) as raised:
        built({"lines": {"hall": HALL, "panel": panel}, **(top or {})})
    return str(raised.value)


HOLDING = {"address": "holding:5"}


@pytest.mark.parametrize(
    ("tag", "device", "said"),
    [
        (HOLDING, {}, "nothing gives it a value: write `source: device/tag`"),
        ({**HOLDING, "source": "mixer/sped"}, {}, "there is no tag mixer/sped"),
        ({**HOLDING, "source": "mixer/run"}, {}, "mixer/run is bool, and this is uint16"),
        (
            {**HOLDING, "source": "mixer/speed", "type": "int16[2]"},
            {},
            "this is int16[2]: an array is shown as an array of the same length",
        ),
        ({**HOLDING, "source": "mixer/speed", "write": True}, {}, "leave out `write`"),
        (
            {**HOLDING, "source": "mixer/speed"},
            {"accept": ["holding:0..holding:9"]},
            "so it has no `source`",
        ),
        ({**HOLDING, "write": True}, {"accept": ["holding:5"]}, "the master writes it"),
        (
            {**HOLDING, "type": "float32"},
            {"accept": ["holding:5"]},
            "is in `accept` only in part: it has 2 words",
        ),
        ({**HOLDING, "retain": True}, {"accept": ["holding:5"]}, "it needs `write: true`"),
        ({**HOLDING, "write": True, "retain": True}, {}, "`gateway: {state: state.json}`"),
        ({**HOLDING, "write": True, "every": "1s"}, {}, "the master decides when it asks"),
        ({**HOLDING, "write": True}, {"accept": ["holding:9..holding:5"]}, "the lower one first"),
        ({**HOLDING, "write": True}, {"accept": ["input:9"]}, "input:9, it is read-only"),
        ({**HOLDING, "write": True}, {"accept": ["holding:9.3"]}, "leave out the bit"),
        ({**HOLDING, "write": True}, {"accept": ["D9"]}, "'D9' is no Modbus address"),
        ({**HOLDING, "write": True}, {"retries": 3}, "retries has no effect"),
    ],
)
def test_a_tag_of_a_station_has_one_origin(
    tag: dict[str, Any], device: dict[str, Any], said: str
) -> None:
    assert said in mistakes({"tag": tag}, **device)


def test_two_tags_show_one_word_only_as_its_bits() -> None:
    bits = {"a": {"address": "holding:5.1", "write": True}}
    assert "a of this device is at holding:5 already" in mistakes(
        {**bits, "b": {"address": "holding:5", "write": True}}
    )
    assert "a of this device is at holding:5.1 already" in mistakes(
        {**bits, "b": {"address": "holding:5.1", "write": True}}
    )


def test_a_standby_group_keeps_no_held_values() -> None:
    top = {"gateway": {"state": "state.json", "standby": "hall"}}
    said = mistakes({"tag": {**HOLDING, "write": True, "retain": True}}, top=top)
    assert "a standby would answer with the values of its own file" in said


def test_a_served_line_has_a_port_and_one_protocol() -> None:
    tag = {"tag": {**HOLDING, "write": True}}
    assert "needs a real port" in mistakes(tag, line={"port": "simulator"})
    ask = {"a": {"send": "A", "match": "(?P<f>.)", "fields": {"f": {"type": "text"}}}}
    frames = {"framing": {"ending": "CR"}, "ask": ask, "protocol": "frames"}
    assert "frames cannot be served: modbus-tcp," in mistakes({}, **frames)
    both = {
        "one": {"protocol": "modbus-rtu", "station": 1, "tags": tag},
        "two": {"protocol": "modbus-ascii", "station": 2, "tags": tag},
    }
    line = {"port": "/dev/ttyS2", "format": "8E1", "baudrate": 9600, "devices": both}
    assert "all stations of a served line speak one protocol" in mistakes({}, line=line)
    line["devices"] = {"all": {"protocol": "modbus-rtu", "station": 0, "tags": tag}}
    assert "station 0 is all stations" in mistakes({}, line=line)


def test_settings_of_served_lines_are_refused_elsewhere() -> None:
    said = mistakes(
        {"tag": {**HOLDING, "retain": True, "source": "mixer/speed"}},
        line={"serve": False},
        accept=["holding:1"],
        stale_after="1s",
    )
    for setting in ("retain", "source", "accept", "stale_after"):
        assert f"{setting} is a setting of served lines" in said


@pytest.mark.parametrize(
    ("identity", "said"),
    [
        ({"vendr": "ABB"}, "does not tell vendr: name a tag of it that is read"),
        ({"command": "1"}, "does not tell command"),
        ({"serial": 1234}, "1234 is no text: write numbers in quotes"),
    ],
)
def test_an_identity_that_the_device_cannot_tell(identity: dict[str, Any], said: str) -> None:
    tags = {"command": {"address": "holding:1", "write": True, "poll": False}}
    drive = {"protocol": "modbus-rtu", "station": 4, "identity": identity, "tags": tags}
    with pytest.raises(ConfigErrors) as raised:
        built({"lines": {"hall": {"port": "/dev/ttyS1", "devices": {"drive": drive}}}})
    assert said in str(raised.value)
