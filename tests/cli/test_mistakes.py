"""Mistakes that are often made, and the sentences that say what is right."""

from pathlib import Path

import pytest

from gateway.config import load
from gateway.errors import ConfigError
from tests.cli.conftest import Command
from tests.e2e.processes import plc_gateway


def refused(folder: Path, line: str) -> str:
    path = folder / "plant.yaml"
    path.write_text(f"lines:\n  hall:\n    {line}\n")
    with pytest.raises(ConfigError) as caught:
        load(path)
    return str(caught.value).replace(f"{path}:", "")


def devices(tag: str) -> str:
    return f"devices: {{mixer: {{protocol: vigor, station: 1, tags: {{{tag}}}}}}}"


@pytest.mark.parametrize(
    ("port", "sentence"),
    [
        ("ttyUSB0", "ttyUSB0 is no port: did you mean /dev/ttyUSB0?"),
        ("COM3", "COM3 is a port of Windows: here it is a path like /dev/ttyUSB0"),
        (r"\\.\COM12", r"\\.\COM12 is a port of Windows: here it is a path like /dev/ttyUSB0"),
        (
            "192.168.0.7",
            "192.168.0.7 is no port: write tcp://192.168.0.7:4001, with its port number",
        ),
    ],
)
def test_a_port_that_is_none(tmp_path: Path, port: str, sentence: str) -> None:
    line = f"port: {port}\n    {devices('a: {address: D1}')}"
    assert refused(tmp_path, line) == f"3: lines.hall.port: {sentence}"


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ('scale: "0,1"', "'0,1' is no number: write 0.1"),
        ('every: "1,5s"', "'1,5s' is no duration: write 1.5s"),
        ('every: "1,5,2s"', "'1,5,2s' is no duration: write 500ms, 2s, 15min, 1h or 7d"),
    ],
)
def test_a_decimal_comma(tmp_path: Path, setting: str, sentence: str) -> None:
    line = f"port: simulator\n    {devices(f'a: {{address: D1, {setting}}}')}"
    assert refused(tmp_path, line).endswith(f": {sentence}")


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
def test_a_bit_is_written_as_on_and_off(running: Path, word: str, value: str) -> None:
    done = plc_gateway("write", running, "mixer/run", word)
    assert (done.code, done.out.split(":")[0]) == (0, f"mixer/run = {value}")
    assert plc_gateway("write", running, "mixer/name", word).out.startswith(f"mixer/name = {word}")
