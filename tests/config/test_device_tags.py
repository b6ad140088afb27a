"""Tags that are written alike are checked once, and each is as if it were alone in the file."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from gateway.config import Config, ConfigErrors, load
from gateway.config.tags import device_tags
from gateway.config.tags.word_tags import build_tag
from gateway.tags import Tag

SPEED = {"address": "D10", "scale": 0.1, "every": "5s", "write": {"min": 0, "max": 9}}


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of all tags that were built, not copied."""
    found: list[str] = []

    def counted(source: Any, *rest: Any) -> Any:
        found.append(f"{source.device}/{source.name}")
        return build_tag(source, *rest)

    monkeypatch.setattr(device_tags, "build_tag", counted)
    return found


def loaded(folder: Path, *devices: dict[str, Any], **sections: Any) -> Config:
    path = folder / "c.yaml"
    named = {
        f"d{n}": {"protocol": "vigor", "station": n + 1, **device}
        for n, device in enumerate(devices)
    }
    lines = {"hall": {"port": "simulator", "devices": named}}
    if any(device.get("protocol", "").startswith("modbus") for device in devices):
        lines["hall"]["baudrate"], lines["hall"]["format"] = 9600, "8N1"  # type: ignore[assignment]
    path.write_text(json.dumps({"lines": lines, **sections}))
    return load(path)


def settings(tag: Tag) -> list[Any]:
    return [getattr(tag, one.name) for one in dataclasses.fields(tag)]


def test_equal_devices_have_their_tags_built_once(tmp_path: Path, built: list[str]) -> None:
    tags = {f"t{n}": {"address": f"D{n}"} for n in range(10)}
    config = loaded(tmp_path, *[{"tags": tags}] * 30)
    assert built == [f"d0/t{n}" for n in range(10)]
    assert len({tag.key for device in config.devices for tag in device.tags}) == 300


def test_a_copied_tag_differs_in_device_and_name_only(tmp_path: Path) -> None:
    both = loaded(tmp_path, {"tags": {"speed": SPEED}}, {"tags": {"Tempo": SPEED}}).devices[1]
    alone = loaded(tmp_path, {"tags": {}}, {"tags": {"Tempo": SPEED}}).devices[1]
    [copied], [built] = both.tags, alone.tags
    assert (copied.device, copied.name) == ("d1", "Tempo")
    assert settings(copied) == settings(built)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"scale": 1}, {"scale": True}),
        ({"write": True}, {"write": 1}),
        ({"offset": 0}, {"offset": False}),
        ({"deadband": 1}, {"deadband": True}),
        ({"history": False}, {"history": 0}),
    ],
    ids=str,
)
def test_values_that_python_takes_for_equal_are_checked_apart(
    tmp_path: Path, first: dict[str, Any], second: dict[str, Any]
) -> None:
    tags = [{"tags": {"a": {"address": "D1", **own}}} for own in (first, second)]
    with pytest.raises(ConfigErrors, match=r"devices\.d1\.tags\.a"):
        loaded(tmp_path, *tags)


def test_a_mistake_is_reported_for_every_device(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors) as raised:
        loaded(tmp_path, *[{"tags": {"a": {"address": "Q1"}}}] * 3)
    assert len(raised.value.messages) == 3


def test_defaults_of_a_device_count(tmp_path: Path, built: list[str]) -> None:
    tags = {"a": {"address": "D1"}}
    config = loaded(tmp_path, {"tags": tags}, {"tags": tags, "defaults": {"every": "7s"}})
    assert [device.tags[0].every for device in config.devices] == [1.0, 7.0]
    assert built == ["d0/a", "d1/a"]


def test_a_broadcast_needs_writable_tags_though_others_do_not(tmp_path: Path) -> None:
    tags = {"a": {"address": "holding:1"}}
    with pytest.raises(ConfigErrors, match=r"devices\.d1\.tags\.a\.write: .* is never read"):
        loaded(
            tmp_path,
            {"protocol": "modbus-rtu", "station": 1, "tags": tags},
            {"protocol": "modbus-rtu", "station": 0, "tags": tags},
        )


def test_history_is_asked_for_by_a_copied_tag_too(tmp_path: Path) -> None:
    tags = {"a": {"address": "D1", "history": True}}
    with pytest.raises(ConfigErrors, match="no `history:` section"):
        loaded(tmp_path, {"tags": tags}, {"tags": tags})
