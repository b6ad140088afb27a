"""A new feature of tags is one module and one line in the list. Only its fields of `@meta` have a
type besides, and a sentence on a page."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from gateway.config import ConfigErrors
from gateway.config.tags.registry import FEATURES
from gateway.config.tags.section import ComputedSection, TagDefaults, TagSection
from gateway.tags import Label, Origin, Publishing, Tag
from gateway.tags.shaping import Shaping
from tests.config.test_templates import loaded

TOY = '''
"""The shelf where the spare part of a sensor lies: a feature of its own."""

from dataclasses import dataclass

from gateway.config.settings import parsers
from gateway.config.tags.features.feature import Feature, Settings
from gateway.config.tags.registry import FEATURES


@dataclass(frozen=True)
class Spare:
    shelf: str


class SpareSettings(Settings):
    shelf: str | None = None
    """The shelf of the spare part."""


def check(own, facts):
    if facts.kind.count:
        yield "shelf", f"a {facts.kind} is many values: it has no spare part"


def meta(tag):
    spare = tag.feature(Spare)
    return {"shelf": spare.shelf if spare else None}


FEATURE = Feature(
    own=SpareSettings,
    check=check,
    make=lambda own, facts: Spare(own.shelf),
    meta=meta,
)
'''
LIST = """
import sys
from gateway.config.tags import registry
import toy
registry.FEATURES = (*registry.FEATURES, toy.FEATURE)
"""
PROGRAM = """
from gateway.cli.main import main
sys.argv = ["plc-gateway", *sys.argv[1:]]
main()
"""
FILE = """\
lines:
  hall:
    port: simulator
    devices:
      mixer:
        protocol: vigor
        station: 1
        tags:
          level: {address: D10, shelf: A3}
          speed: {address: D11}
"""


def run(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    (folder / "toy.py").write_text(TOY)
    command = [sys.executable, "-c", LIST + PROGRAM, *arguments]
    environment = {"PYTHONPATH": f"{folder}:{Path.cwd()}", "PATH": "/usr/bin:/bin", "HOME": "/tmp"}
    return subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, check=False
    )


def test_a_toy_feature_has_settings_check_meta_and_columns(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(FILE)
    exported = run(tmp_path, "export", str(file), "--output", str(tmp_path / "tags.csv"))
    assert exported.returncode == 0, exported.stderr
    titles, level, speed = (tmp_path / "tags.csv").read_text("utf-8-sig").splitlines()
    place = titles.split(",").index("Shelf")
    assert (level.split(",")[place], speed.split(",")[place]) == ("A3", "")
    sheet = tmp_path / "more.csv"
    sheet.write_text("Name,Address,Shelf\ntemperature,D20,B7\n")
    assert run(tmp_path, "import", str(sheet), "--into", str(file)).returncode == 0
    assert "temperature: {address: D20, shelf: B7}" in file.read_text()
    file.write_text(FILE.replace("address: D11", "address: D11, type: 'int16[4]', shelf: A4"))
    wrong = run(tmp_path, "check", str(file))
    assert wrong.returncode != 0
    path = "lines.hall.devices.mixer.tags.speed.shelf"
    assert f"plant.yaml:10: {path}: a int16[4] is many values: it has no spare" in wrong.stderr
    assert '"shelf"' in run(tmp_path, "schema").stdout


def test_without_it_the_setting_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match=r"tags\.level\.shelf: no setting of a tag"):
        loaded(tmp_path, FILE)


def test_each_setting_belongs_to_one_feature() -> None:
    names = [name for one in FEATURES for name in one.names]
    assert len(names) == len(set(names))
    assert set(names) | {"every", "address", "computed"} == TagSection.model_fields.keys()
    inherited = {name for one in FEATURES if one.defaults for name in one.defaults.model_fields}
    assert inherited | {"every"} == TagDefaults.model_fields.keys()
    of_computed = {name for one in FEATURES for name in one.computed}
    assert of_computed | {"computed"} == ComputedSection.model_fields.keys()


def test_a_tag_has_few_fields() -> None:
    for kind in (Tag, Shaping, Publishing, Origin, Label):
        assert len(fields(kind)) <= 15
