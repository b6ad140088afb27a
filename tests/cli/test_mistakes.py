"""Mistakes that are often made, and the sentences that say what is right."""

from pathlib import Path

import pytest

from gateway.config import load
from gateway.config.settings import parsers
from gateway.config.sheets import cells
from gateway.contract.keys import max_age
from gateway.contract.past.timerange import time_range
from gateway.errors import ConfigError
from tests.conftest import Command


def refused(folder: Path, line: str) -> str:
    path = folder / "plant.yaml"
    path.write_text(f"lines:\n  hall:\n    {line}\n")
    with pytest.raises(ConfigError) as caught:
        load(path)
    return str(caught.value).replace(f"{path}:", "")


def devices(tag: str) -> str:
    return f"devices: {{mixer: {{protocol: vigor, station: 1, tags: {{{tag}}}}}}}"


PLANT = """\
gateway: {name: demo}
lines:
  hall-1:
    port: simulator
    devices:
      mixer:
        protocol: vigor
        station: 1
        tags:
          a: {address: D1, scale: 0.1, unit: rpm}
"""
NBSP = "\xa0"
MIXER = "lines.hall-1.devices.mixer"


@pytest.mark.parametrize(
    ("right", "wrong", "sentence"),
    [
        # numbers and their units
        ("scale: 0.1", "scale: 0,1", "10: {a}.1: no setting of a tag: a number has a point, not a"),
        ("scale: 0.1", 'scale: "0,1"', "10: {a}.scale: '0,1' is no number: write 0.1"),
        ("scale: 0.1", 'every: "1,5s"', "10: {a}.every: '1,5s' is no duration: write 1.5s"),
        ("scale: 0.1", "every: 5", "10: {a}.every: 5 has no unit: write 5s or 5ms"),
        ("scale: 0.1", "every: 15M", "10: {a}.every: 15M: M is no unit of time: use min for min"),
        ("scale: 0.1", "every: 30m1h", "10: {a}.every: '30m1h' is no duration: write 500ms, 2s, "),
        ("scale: 0.1", 'every: "1,5,2s"', "10: {a}.every: '1,5,2s' is no duration: write 500ms,"),
        ("station: 1", f"station: 1{NBSP}", r"8: {m}.station: '1\xa0' (\xa0 is a no-break space)"),
        # ports and what is on them
        ("simulator", "ttyUSB0", "4: lines.hall-1.port: ttyUSB0 is no port: did you mean /dev/tty"),
        ("simulator", "COM3", "4: lines.hall-1.port: COM3 is a port of Windows: here it is a path"),
        ("simulator", "COM 3", "4: lines.hall-1.port: COM 3 is a port of Windows: here it is a pa"),
        ("simulator", r"\\.\COM12", r"4: lines.hall-1.port: \\.\COM12 is a port of Windows: here"),
        (
            "simulator",
            "10.0.0.7",
            "4: lines.hall-1.port: 10.0.0.7 is no port: write tcp://10.0.0.7",
        ),
        ("simulator", "simulator\n    format: 8N3", "5: lines.hall-1.format: '8N3' is no charact"),
        ("simulator", "simulator\n    baudrate: 9601", "5: lines.hall-1.baudrate: 9601 is no bau"),
        # addresses and words
        ("D1", "X18", "10: {a}.address: X18: X and Y are numbered in octal, 8 and 9 do not exist"),
        ("D1", "“D1”", "10: {a}.address: '“D1”' is no device address: write it as D100"),
        ("rpm", "“rpm”", "10: {a}.unit: “rpm” has curly quotes: write 'rpm'"),
        ("demo", "“demo”", "1: gateway.name: '“demo”' has '“': names are letters and digits"),
        ("vigor", "vigour", "7: {m}.protocol: 'vigour' is no protocol: did you mean vigor?"),
        ("vigor", f"vigor{NBSP}", r"7: {m}.protocol: 'vigor\xa0' (\xa0 is a no-break space) "),
        ("scale: 0.1", "type: word", "10: {a}.type: 'word' is not a type: use bool, int8"),
        ("scale", "scal", "10: {a}.scal: no setting of a tag: did you mean scale?"),
        # the form of the file
        ("station: 1", "station 1", "8: no colon after station: write station: 1"),
        ("station: 1", "station = 1", "8: no colon after station: write station: 1"),
        ("station: 1", "station:1", "8: no space after a colon: write station: 1"),
        ("protocol: vigor", "protocol vigor", "7: no colon after protocol: write protocol: vigor"),
        ("tags:", "tags", "9: no colon after tags: write tags:"),
        ("a: {", "a {", "10: no colon after a: write a: {{address: D1, scale: 0.1, unit: rpm}}"),
        ("address: D1", "address:D1", "10: {a}.address:D1: no setting of a tag: write a space aft"),
        (
            "        station",
            f"{NBSP * 8}station",
            "8: a no-break space, as web pages and Word have",
        ),
        ("station: 1", f"station:{NBSP}1", "8: a no-break space, as web pages and Word have it"),
        ("        station", "\tstation", "8: a tab: YAML is indented with spaces"),
        ("        station", "       station", "8: no YAML: while parsing a block mapping that beg"),
        ("station: 1", "station: 1\n        station: 2", "8: {m}.station: written twice, here and"),
        ("rpm}", "rpm", "11: no YAML: while parsing a flow mapping that begins in line 10"),
        ("rpm", '"rpm', "11: no YAML: while scanning a quoted scalar that begins in line 10"),
        (
            "gateway:",
            "<<<<<<< HEAD\ngateway:",
            "1: <<<<<<< is a mark of a merge conflict: keep one of the two versions",
        ),
        (
            "lines:",
            "=======\nlines:",
            "2: ======= is a mark of a merge conflict: keep one of the two versions",
        ),
    ],
)
def test_a_mistake_has_its_line_its_cause_and_what_is_right(
    tmp_path: Path, right: str, wrong: str, sentence: str
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT.replace(right, wrong, 1))
    with pytest.raises(ConfigError) as caught:
        load(path)
    said = str(caught.value).replace(f"{path}:", "").splitlines()
    expected = sentence.format(m=MIXER, a=f"{MIXER}.tags.a")
    assert any(line.startswith(expected) for line in said), said


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("15m", 900), ("15min", 900), ("1h30m", 5400), ("1h 30 min", 5400), ("1d12h", 129_600)],
)
def test_a_duration_is_the_same_in_file_sheet_range_and_query(text: str, seconds: int) -> None:
    assert parsers.duration(text) == max_age(text) == seconds
    assert parsers.duration(cells.duration(text, "")) == seconds
    now = 10**18
    for asked in (text, f"[now(-{text})..]"):
        assert time_range(asked, now).first == now - seconds * 10**9


def test_a_history_larger_than_its_disk_is_a_warning(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(f"{PLANT}history: {{path: h.db, max_size: 900TB}}\n")
    warning = command("check", path).err
    assert "warning: history.max_size: 900000 GB, but the disk of " in warning


def test_one_port_under_two_names(tmp_path: Path) -> None:
    port, link = tmp_path / "port", tmp_path / "link"
    port.touch()
    link.symlink_to(port)
    first = f"port: {port}\n    {devices('a: {address: D1}')}"
    second = f"port: {link}\n    {devices('a: {address: D1}').replace('mixer', 'oven')}"
    assert refused(tmp_path, f"{first}\n  yard:\n    {second}") == (
        "6: lines.yard.port: line hall has this port already: one port is one line, with all its "
        "devices"
    )


def test_many_mistakes_with_one_cause_are_counted(tmp_path: Path) -> None:
    tags = ", ".join(f"t{n}: {{adress: D{n}}}" for n in range(201))
    said = refused(tmp_path, f"port: simulator\n    {devices(tags)}").splitlines()
    assert len(said) == 11
    assert said[9].endswith("tags.t9.adress: no setting of a tag: did you mean address?")
    assert said[10] == "4: 191 more like: no setting of a tag: did you mean address?"


def test_mistakes_with_other_causes_are_all_told(tmp_path: Path) -> None:
    tags = ", ".join(f"t{n}: {{adress: D{n}}}" for n in range(30))
    said = refused(tmp_path, f"port: simulator\n    {devices(tags + ', u: {every: 5}')}")
    assert "tags.u.address: missing: a tag needs it" in said
    assert "tags.u.every: 5 has no unit" in said
    assert "20 more like: no setting of a tag" in said


def test_a_similar_tag_is_suggested(command: Command, config: Path) -> None:
    assert command("write", config, "mixer/trimm", "1").err.endswith(": did you mean mixer/trim?\n")
    assert command("read", config, "mixr").err.endswith("mixr: did you mean mixer?\n")
    assert command("read", config, "mixer/sped").err.endswith(": did you mean mixer/speed?\n")
    assert (
        command("read", config, "kettle/volume").err == "there is no tag or device kettle/volume\n"
    )


def test_check_strict_fails_on_an_overloaded_line(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    tags = ", ".join(f"t{n}: {{address: D{n * 100}, every: 100ms}}" for n in range(30))
    path.write_text(f"lines: {{hall: {{port: simulator, {devices(tags)}}}}}\n")
    assert command("check", path).code == 0
    assert command("check", "--strict", path).code == 1
    path.write_text(f"lines: {{hall: {{port: simulator, {devices('a: {address: D1}')}}}}}\n")
    assert command("check", "--strict", path).code == 0


@pytest.mark.parametrize(("word", "value"), [("on", "true"), ("OFF", "false")])
def test_a_bit_is_written_as_on_and_off(
    command: Command, running: Path, word: str, value: str
) -> None:
    done = command("write", running, "mixer/run", word)
    assert (done.code, done.out.split(":")[0]) == (0, f"mixer/run = {value}")
    assert command("write", running, "mixer/name", word).out.startswith(f"mixer/name = {word}")
