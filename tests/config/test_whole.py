"""A file as it travels to another machine, and a patch of one."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.config.whole import patched_text, whole_text
from gateway.errors import ConfigError

FILE = """\
# The hall
zenoh: {prefix: works}
templates_from: [pumps.yaml]
templates: {own: {use: pump, defaults: {every: 2s}}}
lines:
  hall:
    port: simulator
    devices:
      mixer: {tags: {own: {address: "D9"}}, tags_from: mixer.csv, protocol: vigor, station: 1}
      pump: {use: own, base: 100, station: 2, tags_from: pump.csv}
      "p-{n}": {use: pump, repeat: 2, base: "{n * 100}", station: "{n + 2}"}
"""
PUMPS = (
    'templates: {pump: {parameters: [base], protocol: vigor, tags: {speed: {address: "D{base}"}}}}'
)
SHEET = """\
name,address,type,unit,description,scale,enum,alarm,every
speed,D100,int16,rpm,"Speed, of the mixer",0.1,,"{high: 100}",1s
mode,40101,uint16,1,007,,"{0: off, 1: auto}",,
on,M1,,,yes,,,,30s
"""


def plant(folder: Path, text: str = FILE) -> Path:
    (folder / "pumps.yaml").write_text(PUMPS)
    (folder / "mixer.csv").write_text(SHEET.replace("40101", "D101"))
    (folder / "pump.csv").write_text("name,address\nflow,D7\n")
    (path := folder / "plant.yaml").write_text(text)
    return path


def test_a_whole_file_does_the_same_where_no_other_file_is(tmp_path: Path) -> None:
    path = plant(tmp_path)
    (there := tmp_path / "there").mkdir()
    (alone := there / "plant.yaml").write_text(whole_text(path))
    one, other = load(path), load(alone)
    assert one.digest == other.digest
    tags = [
        [(tag.key, tag.text) for dev in file.devices for tag in dev.tags] for file in (one, other)
    ]
    assert tags[0] == tags[1]
    assert whole_text(alone) == alone.read_text()
    (tmp_path / "pump.csv").write_text("name,address\nflow,D8\n")
    assert load(path).digest != other.digest


def test_a_file_that_names_no_other_one_keeps_its_comments(tmp_path: Path) -> None:
    path = plant(tmp_path, "# The hall\nlines: {hall: {port: simulator, devices: {}}}\n")
    assert whole_text(path) == path.read_text()


def test_a_sheet_that_cannot_travel_is_named(tmp_path: Path) -> None:
    path = plant(
        tmp_path, FILE.replace("base: 100,", "base: 100, repeat: 1,").replace("pump:", '"x-{n}":')
    )
    with pytest.raises(ConfigError, match=r"x-1 has pump\.csv from a template or by `repeat`"):
        whole_text(path)
    (tmp_path / "pump.csv").unlink()
    with pytest.raises(ConfigErrors, match=r"pump\.csv cannot be read"):
        whole_text(path)


def test_a_patch_changes_what_it_names(tmp_path: Path) -> None:
    path = plant(tmp_path)
    new = {"use": "pump", "base": 400, "station": 9}
    devices = {"mixer": {"station": 7}, "pump": None, "pump-9": new}
    text = patched_text(path, {"lines": {"hall": {"devices": devices}}})
    (other := tmp_path / "other.yaml").write_text(text)
    found = {device.name: device.driver.station for device in load(other).devices}
    assert found == {"mixer": 7, "p-1": 3, "p-2": 4, "pump-9": 9}
    deep: dict[str, object] = {}
    for _ in range(100):
        deep = {"a": deep}
    with pytest.raises(ConfigError, match="more than"):
        patched_text(path, deep)
