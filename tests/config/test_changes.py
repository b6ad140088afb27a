"""The difference between two files: what goes on, what begins again, what needs a restart."""

from dataclasses import replace
from pathlib import Path

import pytest

from gateway.config import Config, built, load
from gateway.config.changes import compare, needs_restart
from tests.reload.plant import Data, file, vigor

ROOT = Path(__file__).parents[2]
FILES = [ROOT / "config.example.yaml", *sorted((ROOT / "examples").glob("*.yaml"))]


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])
def test_a_file_that_is_read_twice_has_no_difference(path: Path) -> None:
    first, second = load(path), load(path)
    difference = compare(first, second)
    assert not difference
    assert difference.config.devices == first.devices  # tags are equal to themselves only
    assert needs_restart(first, second) == []


SHAPED: dict[str, Data] = {
    "a": {"address": "D10", "decimals": 1, "clamp": [0, 100], "from": [0, 4000], "to": [0, 100]},
    "b": {"address": "D11", "enum": {"0": "off", "1": "auto"}},
    "c": {"computed": "a * 2"},
}


def test_shaped_and_computed_tags_are_equal_when_read_twice() -> None:
    first, second = (built(file(hall={"mixer": vigor(1, **SHAPED)})) for _ in range(2))
    difference = compare(first, second)
    assert not difference
    assert difference.config.devices == first.devices


def test_a_line_that_answers_needs_a_restart() -> None:
    def answering(address: str) -> Data:
        changed = data()
        tags = {"speed": {"address": address, "source": "mixer/speed"}}
        station = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
        changed["lines"]["panel"] = {
            "port": "tcp://127.0.0.1:1502",
            "serve": True,
            "devices": {"panel": station},
        }
        return changed

    old, same, new = (built(answering(f"holding:{n}")) for n in (1, 1, 2))
    assert needs_restart(old, same) == []
    assert not compare(old, same)
    assert needs_restart(old, new) == ["lines.panel"]
    assert needs_restart(old, built(data())) == ["lines.panel"]


@pytest.mark.parametrize(
    ("name", "one", "other", "changed"),
    [
        ("share", {"doors": {"tool": {"max_age": "1s"}}}, {"doors": {"tool": {}}}, "share"),
        ("share", {"doors": {"tool": {}}}, None, "share"),
        ("share", None, {"doors": {"tool": {}}}, "share"),
        ("history", {"keep": "1d"}, {"keep": "2d"}, "history.keep"),
        ("alarms", {"path": "a.json"}, {"path": "b.json"}, "alarms.path"),
        ("web", {"listen": "127.0.0.1:1"}, {"listen": "127.0.0.1:2"}, "web.listen"),
        ("web", {"listen": "127.0.0.1:1"}, None, "web"),
    ],
)
def test_a_changed_section_of_a_part_needs_a_restart(
    name: str, one: Data | None, other: Data | None, changed: str
) -> None:
    """A reload with other doors ended the process."""

    def made(section: Data | None) -> Config:
        document = data() if section is None else {**data(), name: section}
        for door in document.get("share", {}).get("doors", {}).values():
            door |= {"line": "hall", "listen": "127.0.0.1:1502", "protocol": "vigor"}
        return built(document)

    assert needs_restart(made(one), made(other)) == [changed]


def data(**tag: object) -> Data:
    mixer = vigor(1, level={"address": "D10"}, speed={"address": "D11", **tag})
    return file(hall={"mixer": mixer, "oven": vigor(2)})


@pytest.mark.parametrize(
    ("setting", "goes_on"),
    [
        ({"every": "5s"}, True),
        ({"description": "of the drum"}, True),
        ({"write": True}, True),
        ({"deadband": 2}, True),
        ({"payload": "raw"}, True),
        ({"unit": "rpm"}, False),
        ({"scale": 0.1}, False),
        ({"type": "uint16"}, False),
        ({"address": "D12"}, False),
    ],
)
def test_a_value_goes_on_while_its_meaning_does(setting: Data, goes_on: bool) -> None:
    old, new = built(data()), built(data(**setting))
    (change,) = compare(old, new).devices.values()
    level, speed = old.devices[0].tags
    assert change.continues
    assert change.kept == {level}
    assert change.gone == [speed]
    assert list(change.renewed) == ([speed] if goes_on else [])
    assert [tag.name for tag in change.started] == ([] if goes_on else ["speed"])


def test_another_station_begins_again_with_all_its_tags() -> None:
    changed = data()
    changed["lines"]["hall"]["devices"]["mixer"]["station"] = 7
    (change,) = compare(built(data()), built(changed)).devices.values()
    assert not change.continues
    assert (len(change.gone), len(change.started), change.renewed) == (2, 2, {})


def test_a_line_with_another_speed_is_opened_again() -> None:
    changed = data()
    changed["lines"]["hall"]["baudrate"] = 9600
    difference = compare(built(data()), built(changed))
    assert (difference.closed, [line.name for line in difference.opened]) == (["hall"], ["hall"])
    assert list(difference.devices) == ["mixer", "oven"]


def test_settings_of_the_process_need_a_restart() -> None:
    old = built(data())
    zenoh = replace(old.zenoh, listen=("tcp/127.0.0.1:7448",), prefix="other")
    new = replace(old, name="other", zenoh=zenoh, parts={"alarms": old.parts["alarms"]}, watch=True)
    assert needs_restart(old, new) == ["gateway.name", "zenoh.prefix", "zenoh.listen"]
