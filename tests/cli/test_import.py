"""The commands `import` and `export`."""

import csv
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.cli.sheets.import_command import _meaning
from gateway.config import load
from gateway.config.yaml.insert import with_tags, written
from gateway.errors import ConfigError
from tests.conftest import Command
from tests.e2e.processes import ROOT
from tests.sheets import plant

FILE = """\
# The south plant, see drawing 17.
gateway: {name: demo}
lines:
  hall-1:
    port: simulator   # later /dev/ttyUSB0
    devices:
      mixer: {protocol: vigor, station: 1, tags: {}}   # found by scan
"""
TWO = FILE + "      oven: {protocol: vigor, station: 2, tags: {x: {address: D9}}}\n"


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture(name="plant_file")
def _plant_file(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


def sheet(folder: Path, text: str) -> Path:
    path = folder / "tags.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_300_tags_are_imported_and_the_comments_stay(command: Command, plant_file: Path) -> None:
    tags = plant_file.with_name("tags.csv")
    tags.write_bytes(plant.german(plant.points()))
    done = command("import", tags, "--into", plant_file)
    assert done.code == 0
    assert done.out == (
        "plant.yaml: 300 tags of tags.csv added to mixer\nthe file before is plant.yaml.bak\n"
    )
    assert "note: tags.csv: columns not used: Schrank" in done.err
    text = plant_file.read_text("utf-8")
    assert text.startswith(
        FILE.replace("mixer: {protocol: vigor, station: 1, tags: {}}   #", "¦")[:99]
    )
    assert "      mixer:  # found by scan\n        protocol: vigor\n        station: 1\n" in text
    assert "          # 300 tags from tags.csv\n" in text
    assert plant_file.with_name("plant.yaml.bak").read_text("utf-8") == FILE
    assert files(plant_file.parent) == ["plant.yaml", "plant.yaml.bak", "tags.csv"]
    assert len(load(plant_file).devices[0].tags) == 300


def test_tags_are_imported_into_a_file_with_computed_tags(
    command: Command, plant_file: Path
) -> None:
    shutil.copy(ROOT / "config.example.yaml", plant_file)
    tags = sheet(plant_file.parent, "Name,Address\nof-the-sheet,D700\n")
    done = command("import", tags, "--into", plant_file, "--device", "mixer")
    assert (done.code, done.err) == (0, "")
    assert "          of-the-sheet: {address: D700}\n" in plant_file.read_text("utf-8")


def test_with_one_mistake_nothing_is_written(command: Command, plant_file: Path) -> None:
    tags = sheet(plant_file.parent, "Name,Address,Scale\na,D1,1\nb,D2,one\nc,D99999,1\n")
    done = command("import", tags, "--into", plant_file)
    assert done.code == 2
    first, second, last = done.err.splitlines()
    assert first == "tags.csv: row 3, column C (Scale): 'one' is no number"
    assert second.startswith("tags.csv: row 4, column B (Address): ")
    assert last == "2 mistakes: nothing was written"
    assert plant_file.read_text("utf-8") == FILE
    assert files(plant_file.parent) == ["plant.yaml", "tags.csv"]


def test_an_insertion_that_would_change_other_tags_is_not_written(
    command: Command, plant_file: Path
) -> None:
    """The own `tags` of a device hide those that it merges."""
    merged = FILE.replace(
        "{protocol: vigor, station: 1, tags: {}}",
        "\n        <<: {tags: {b: {address: D9}}}\n        protocol: vigor\n        station: 1",
    )
    plant_file.write_text(merged, encoding="utf-8")
    tags = sheet(plant_file.parent, "Name,Address\na,D1\n")
    done = command("import", tags, "--into", plant_file)
    assert done.code == 2
    assert "the tags cannot be inserted into plant.yaml as it is written" in done.err
    assert plant_file.read_text("utf-8") == merged
    assert files(plant_file.parent) == ["plant.yaml", "tags.csv"]


def test_the_device_is_named_or_the_only_one_or_in_the_sheet(
    command: Command, plant_file: Path
) -> None:
    plant_file.write_text(TWO, encoding="utf-8")
    tags = sheet(plant_file.parent, "Name,Address\na,D1\n")
    assert command("import", tags, "--into", plant_file).err == (
        "name the device with --device: plant.yaml has mixer, oven\n"
    )
    wrong = command("import", tags, "--into", plant_file, "--device", "mixr")
    assert "there is no device mixr" in wrong.err
    assert "did you mean mixer?" in wrong.err
    assert command("import", tags, "--into", plant_file, "--device", "oven").code == 0
    both = sheet(plant_file.parent, "Device,Name,Address\nmixer,b,D1\noven,c,D2\n")
    assert "added to oven" in command("import", both, "--into", plant_file).out
    names = {tag.key for device in load(plant_file).devices for tag in device.tags}
    assert names == {"oven/x", "oven/a", "mixer/b", "oven/c"}


def test_a_second_import_of_the_same_tags_is_refused(command: Command, plant_file: Path) -> None:
    tags = sheet(plant_file.parent, "Name,Address\na,D1\n")
    assert command("import", tags, "--into", plant_file).code == 0
    after = plant_file.read_bytes()
    done = command("import", tags, "--into", plant_file)
    assert done.code == 2
    assert "row 2, column A (Name): a is in `tags` of mixer already" in done.err
    assert plant_file.read_bytes() == after


def test_without_a_file_the_tags_are_printed(command: Command, plant_file: Path) -> None:
    tags = sheet(plant_file.parent, "Name,Address,Unit\na,D1,%\n")
    done = command("import", tags)
    assert yaml.safe_load(done.out) == {"tags": {"a": {"address": "D1", "unit": "%"}}}
    assert "addresses and limits are not checked yet" in done.err


def test_a_link_to_the_file_stays_a_link_and_the_mode_stays(
    command: Command, plant_file: Path
) -> None:
    plant_file.chmod(0o640)
    link = plant_file.with_name("link.yaml")
    link.symlink_to(plant_file)
    tags = sheet(plant_file.parent, "Name,Address\na,D1\n")
    assert command("import", tags, "--into", link).code == 0
    assert link.is_symlink()
    assert plant_file.stat().st_mode & 0o777 == 0o640
    assert "a: {address: D1}" in plant_file.read_text("utf-8")


# ---- the text of the file ------------------------------------------------------------------------

TAGS: dict[str, dict[str, object]] = {
    "speed": {"address": "D100", "scale": 0.1, "unit": "%", "description": 'a: b, c #d "q"'},
    "a/b": {"address": "holding:1", "every": "500ms", "unit": "°C", "type": "string[4]"},
    "010": {"address": "00101", "description": "true", "write": {"min": 1, "max": 40}},
}
BLOCK = """\
# top
lines:
  h:
    devices:
      mixer:   # big
        protocol: vigor
        tags:
          a: {address: D1}  # first
          b:   # second
            address: D2   # deep

        # about the station
        station: 1
      # about the oven
      oven: {protocol: vigor}
"""
MIXER = "lines:\n  h:\n    devices:\n      mixer:"


def read_as_texts(text: str) -> Any:
    return yaml.load(text, yaml.BaseLoader)  # noqa: S506  (only texts, no objects)


FORMS = {
    "tags as a block": BLOCK,
    "no tags yet": f"{MIXER}\n        protocol: vigor\n        tags: {{}}  # none\n        x: 1\n",
    "nothing after tags": f"{MIXER}\n        protocol: vigor\n        tags:",
    "no key tags": f"{MIXER}\n        p: vigor\n        d:\n          every: 1s # x\n      # y\n",
    "no newline at the end": f"{MIXER}\n        protocol: vigor",
    "a device in braces": f"{MIXER} {{p: vigor, station: 1, tags: {{}}}}  # found\n      o: {{}}\n",
    "braces without tags": f"{MIXER} {{p: vigor}}\n",
    "tags in braces": f"{MIXER} {{p: vigor, tags: {{a: {{address: D1}}}}}} # c\n",
    "tags in braces over lines": f"{MIXER}\n        tags: {{\n          a: {{}}, # 1\n        }}\n",
}


@pytest.mark.parametrize("newline", ["\n", "\r\n"], ids=["unix", "windows"])
@pytest.mark.parametrize("form", FORMS)
def test_tags_are_inserted_into_every_form_of_a_file(form: str, newline: str) -> None:
    text = FORMS[form].replace("\n", newline)
    result = with_tags("plant.yaml", text, "mixer", TAGS, "3 tags from tags.csv")
    before, after = yaml.safe_load(text), read_as_texts(result)
    mixer = before["lines"]["h"]["devices"]["mixer"]
    assert set(after["lines"]["h"]["devices"]["mixer"]) == {*mixer, "tags"}
    found = after["lines"]["h"]["devices"]["mixer"]["tags"]
    assert set(found) == {*(mixer.get("tags") or {}), *TAGS}
    assert found["speed"]["description"] == 'a: b, c #d "q"'
    for comment in (line.partition("#")[2] for line in FORMS[form].splitlines()):
        assert comment in result
    assert result.count("\r\n") == (result.count("\n") if newline == "\r\n" else 0)


def test_a_block_keeps_every_line() -> None:
    result = with_tags("plant.yaml", BLOCK, "mixer", TAGS, "3 tags from tags.csv")
    lines = result.splitlines()
    assert [line for line in lines if line in BLOCK.splitlines()] == BLOCK.splitlines()
    at = lines.index("          # 3 tags from tags.csv")
    assert lines[at - 1] == "            address: D2   # deep"


@pytest.mark.parametrize(
    "text",
    [
        f"x: &tags {{a: {{}}}}\n{MIXER}\n        tags: *tags\n",
        f"x: &device {{p: vigor}}\n{MIXER} *device\n",
        f"{MIXER} {{p: vigor,\n         q: 1}}\n",
        f"{MIXER}\n        tags: none\n",
    ],
)
def test_a_form_that_cannot_be_extended_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="tags_from"):
        with_tags("plant.yaml", text, "mixer", TAGS, "")


@pytest.mark.parametrize(
    "value",
    [
        *("true", "null", "~", "1e3", "010", "a: b", "#x", "x #y", "%", "@", "a, b", "[x", "- x"),
        *("", "'", '"', "\\", " x", "x ", "ü°C", "m³/h", "500ms", "a\tb", "\x85", "馬達", "="),
    ],
)
def test_every_text_is_written_so_that_it_is_read_as_the_same_text(value: str) -> None:
    text = f"{MIXER}\n        tags:"
    result = with_tags("plant.yaml", text, "mixer", {"a": {"description": value}}, "")
    device = read_as_texts(result)["lines"]["h"]["devices"]["mixer"]
    (found,) = device["tags"].values()
    assert found == {"description": value}
    assert written(value)[0] in "\"'" or value not in ("true", "null", "~", "1e3", "010", "")


# ---- export --------------------------------------------------------------------------------------

RICH = """\
gateway: {name: demo}
history: {path: history.db}
lines:
  hall-1:
    port: simulator
    devices:
      mixer:
        protocol: vigor
        station: 1
        tags:
          speed: {address: D100, scale: 0.1, offset: -5, unit: rpm, every: 500ms, deadband: 2%}
          level: {address: D10, type: float32, word_order: high_first, history: true,
            clamp: [0, 1000], range: [null, 900]}
          text: {address: D600, type: "string[16]", byte_order: high_first, every: 15s}
          door: {address: M12, description: "Door; \\"open\\"", heartbeat: 1min, publish: always}
          batches: {address: C200, description: "=cmd|' /C calc'!A0", unit: "-"}
          evil: {address: M13, description: "'+1", unit: "@SUM(1)"}
          recipe: {address: D500, write: {min: 2, max: 40, verify: true}, payload: raw}
"""


@pytest.mark.parametrize("comma", [False, True])
def test_an_export_imports_as_the_same_tags(
    comma: bool, command: Command, plant_file: Path
) -> None:
    rich = plant_file.with_name("rich.yaml")
    rich.write_text(RICH, encoding="utf-8")
    empty = plant_file.with_name("empty.yaml")
    empty.write_text(RICH[: RICH.index("        tags:")], encoding="utf-8")
    exported = plant_file.with_name("tags.csv")
    options = ["--decimal-comma"] if comma else []
    done = command("export", rich, "--output", exported, *options)
    assert done.out == f"{exported}: 7 tags of {rich}\n"
    cells = exported.read_text("utf-8-sig")
    formulas = [cell for cell in re.split('[;,"\n]', cells) if cell[:1] in tuple("=+-@")]
    assert [cell for cell in formulas if not re.fullmatch(r"-\d+", cell)] == []
    assert command("import", exported, "--into", empty).code == 0
    assert _meaning(load(empty)) == _meaning(load(rich))


def test_an_export_has_the_keys_for_scada(command: Command, plant_file: Path) -> None:
    plant_file.write_text(RICH, encoding="utf-8")
    done = command("export", plant_file, "mixer/recipe")
    (row,) = csv.DictReader(done.out.splitlines())
    assert row["Key"] == "plant/mixer/recipe"
    assert row["Write key"] == "plant/mixer/recipe/@set"
    assert (row["R/W"], row["Min"], row["Max"], row["Verify"]) == ("R/W", "2", "40", "yes")
    assert (row["Value type"], row["Every"]) == ("int16", "1s")
