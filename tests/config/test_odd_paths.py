"""Odd paths in a file: each is a mistake with its line, and nothing else happens."""

import os
from pathlib import Path

import pytest

from gateway.config import Config, ConfigErrors, load

FILE = """\
gateway: {{name: g{gateway}}}
zenoh: {{{zenoh}}}
lines:
  l:
    port: {port}
    devices:
      d: {{protocol: modbus-rtu, station: 1{device}, tags: {{a: {{address: "holding:1"}}}}}}
{top}
"""
EMPTY = dict.fromkeys(("gateway", "zenoh", "device", "top"), "") | {"port": "simulator"}
READ = [  # settings that name a file to read, with the line of the mistake
    ("gateway", ", secret_file: {}", 1),
    ("zenoh", "config_file: {}", 2),
    ("zenoh", "users_file: {}", 2),
    ("zenoh", "user: a, password_file: {}", 2),
    ("zenoh", "tls: {{ca: {}}}", 2),
    ("device", ", tags_from: {}", 7),
    ("top", "templates_from: {}", 8),
    ("top", "writers: {{file: {}}}", 8),
    ("top", "web: {{tokens_file: {}}}", 8),
]
WRITTEN = [
    ("gateway", ", state: {}", 1),
    ("top", "history: {{path: {}}}", 8),
    ("top", "alarms: {{path: {}}}", 8),
    ("port", "{}", 5),
]
NO_NAMES = ["a" * 300, "/dev/a\\0b", "/", "..", "", "/".join(["a" * 200] * 30)]
NO_FILES = ["missing", "pipe", "folder", "loop", "c.yaml/x", "/dev/zero"]


def loaded(folder: Path, place: str, setting: str, name: str) -> Config:
    (folder / "folder").mkdir()
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    text = FILE.format(**(EMPTY | {place: setting.format(f'"{name}"')}))
    (folder / "c.yaml").write_text(text)
    return load(folder / "c.yaml")


@pytest.mark.parametrize(("place", "setting", "line"), READ + WRITTEN)
@pytest.mark.parametrize("name", NO_NAMES)
def test_a_name_that_no_file_can_have(
    tmp_path: Path, place: str, setting: str, line: int, name: str
) -> None:
    with pytest.raises(ConfigErrors, match=rf"c\.yaml:{line}: "):
        loaded(tmp_path, place, setting, name)


@pytest.mark.parametrize(("place", "setting", "line"), READ)
@pytest.mark.parametrize("name", NO_FILES)
def test_a_file_that_cannot_be_read(
    tmp_path: Path, place: str, setting: str, line: int, name: str
) -> None:
    with pytest.raises(ConfigErrors, match=rf"c\.yaml:{line}: "):
        loaded(tmp_path, place, setting, name)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("pipe", "cannot be read: this is no regular file"),
        ("folder", "this is a folder: name the file in it"),
        ("missing", "there is no such file"),
        ("a" * 300, "cannot be read: File name too long"),
        ("a\0b", "cannot be read: no file can have this name"),
    ],
)
def test_the_file_itself_is_no_file(tmp_path: Path, name: str, why: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigErrors, match=why):
        load(tmp_path / name)


def test_a_file_of_700_mb_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "c.yaml").open("wb") as sparse:
        sparse.truncate(700 * 2**20)
    with pytest.raises(ConfigErrors, match="it has more than 32 MB"):
        load(tmp_path / "c.yaml")
