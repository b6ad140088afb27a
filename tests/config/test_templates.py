"""Templates: what they become, and each mistake with the template's place and the device."""

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.config import Config, ConfigErrors, expanded_text, load
from gateway.config.loading import dumped
from gateway.config.messages import Mistakes
from gateway.config.templates.expand import expanded
from gateway.config.templates.files import SHIPPED
from gateway.config.templates.text import filled
from gateway.config.whole import whole_text
from gateway.config.yaml.file import YamlFile, read_yaml
from gateway.errors import ConfigError
from gateway.tags import Tag
from gateway.tags.scaling import Ends
from tests.config import manual_tables as manual
from tests.conftest import Command

HEAD = """\
lines:
  hall:
    port: simulator
    baudrate: 19200
    format: 7E1
    devices:
"""
OCTAL = "X8: X and Y are numbered in octal, 8 and 9 do not exist"
PUMP = """\
templates:
  pump:
    parameters: {base: null, valves: 2}
    protocol: vigor
    defaults: {every: 2s}
    tags:
      speed: {address: "D{base}", scale: 0.1, unit: rpm}
      flow: {address: "D{base + 1}"}
      "valve-{i}": {repeat: "{valves}", address: "M{base*10 + i}"}
"""


EXPANDED = """\
lines:
  hall:
    port: simulator
    baudrate: 19200
    format: "7E1"
    devices:
      p:
        protocol: vigor
        defaults: {every: 2s}
        station: 3
        tags:
          speed: {address: D100, scale: 0.1, unit: rpm}
          flow: {address: D101}
          valve-1: {address: M1001}
          valve-2: {address: M1002}
"""


def loaded(folder: Path, text: str) -> Config:
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    config = load(path)
    # The file that `check --expand` prints is the same one, without templates.
    alone = folder / "expanded.yaml"
    alone.write_text(expanded_text(path), encoding="utf-8")
    assert "use:" not in alone.read_text()
    # Tags are equal to themselves only. The names of the templates are gone, nothing else.
    plain = re.sub(r"templates=\([^)]*\)", "templates=()", repr(config))
    assert repr(load(alone)) == plain
    # As it travels to another machine, which has no other file of it.
    (elsewhere := folder / "elsewhere").mkdir(exist_ok=True)
    (there := elsewhere / "plant.yaml").write_text(whole_text(path), encoding="utf-8")
    assert load(there).digest == config.digest
    return config


def tags(config: Config) -> dict[str, str]:
    return {tag.key: tag.text for device in config.devices for tag in device.tags}


def mistakes(folder: Path, text: str, **files: str) -> list[str]:
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(content, encoding="utf-8")
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigErrors) as error:
        load(path)
    return [message.replace(f"{folder}/", "") for message in error.value.messages]


def test_a_device_uses_a_template_with_its_own_values(tmp_path: Path) -> None:
    config = loaded(tmp_path, f"{PUMP}{HEAD}      p: {{use: pump, base: 100, station: 3}}\n")
    assert tags(config) == {
        "p/speed": "D100",
        "p/flow": "D101",
        "p/valve-1": "M1001",
        "p/valve-2": "M1002",
    }
    speed = config.devices[0].tags[0]
    assert (speed.shaping.scale, speed.label.unit, speed.every) == (0.1, "rpm", 2.0)


def test_settings_of_the_device_are_above_those_of_the_template(tmp_path: Path) -> None:
    own = """\
      p:
        use: pump
        base: 0
        valves: 1
        station: 3
        defaults: {unit: A}
        tags:
          speed: {every: 9s}
          flow:
          more: {address: "D{base + 50}"}
"""
    config = loaded(tmp_path, f"{PUMP}{HEAD}{own}")
    assert tags(config) == {"p/speed": "D0", "p/valve-1": "M1", "p/more": "D50"}
    speed, valve, _ = config.devices[0].tags
    assert (speed.shaping.scale, speed.every, valve.label.unit, valve.every) == (0.1, 9.0, "A", 2.0)


def test_a_list_of_a_template_has_values_of_the_device(tmp_path: Path) -> None:
    template = "templates:\n  t: {parameters: [low], protocol: vigor, tags: {level: {address: D0, "
    template += 'from: ["{low}", 20000], to: [0, 100]}}}\n'
    config = loaded(tmp_path, f"{template}{HEAD}      p: {{use: t, low: 4000, station: 3}}\n")
    [level] = config.devices[0].tags
    assert level.shaping.ends == Ends((4000, 20000), (0, 100))


def test_a_device_is_repeated(tmp_path: Path) -> None:
    own = '      "p-{n:02}": {use: pump, repeat: 12, base: "{n*10}", station: "{n + 10}"}\n'
    config = loaded(tmp_path, f"{PUMP}{HEAD}{own}")
    assert [device.name for device in config.devices] == [f"p-{n:02}" for n in range(1, 13)]
    assert [getattr(device.driver, "station", 0) for device in config.devices] == [*range(11, 23)]
    assert tags(config)["p-12/flow"] == "D121"


def test_templates_use_templates_and_stand_in_other_files(tmp_path: Path) -> None:
    (tmp_path / "more.yaml").write_text(
        "templates:\n  big:\n    use: pump\n    parameters: [base]\n"
        '    tags: {speed: {deadband: 5}, level: {address: "D{base + 2}"}}\n'
    )
    text = f"templates_from: [more.yaml]\n{PUMP}{HEAD}      p: {{use: big, base: 10, station: 1}}\n"
    config = loaded(tmp_path, text)
    assert list(tags(config)) == ["p/speed", "p/flow", "p/valve-1", "p/valve-2", "p/level"]
    band = config.devices[0].tags[0].publishing.deadband
    assert band is not None
    assert band.amount == 5


def test_a_file_without_templates_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(
        f"{HEAD}      p: {{protocol: vigor, station: 1, tags: {{a: {{address: D1}}}}}}\n"
    )
    file, found = read_yaml(path, frozenset())
    assert expanded(file, found, tmp_path) is file.data
    assert found.places is file


def test_a_mistake_in_a_template_names_its_place_and_the_device(tmp_path: Path) -> None:
    wrong = PUMP.replace("scale", "scal").replace('"D{base + 1}"', '"X{base}"')
    own = "      p: {use: pump, base: 8, station: 3}\n      q: {use: pump, base: 7, station: 4}\n"
    scale, flow = "plant.yaml:7: templates.pump.tags.speed.scal", "templates.pump.tags.flow.address"
    assert mistakes(tmp_path, f"{wrong}{HEAD}{own}") == [
        f"{scale}: used by p in line 16: no setting of a tag: did you mean scale?",
        f"{scale}: used by q in line 17: no setting of a tag: did you mean scale?",
        f"plant.yaml:8: {flow}: used by p in line 16: {OCTAL}",
    ]


def test_a_mistake_in_a_file_of_templates_has_that_file(tmp_path: Path) -> None:
    more = "templates:\n  t:\n    tags:\n      a: {address: D1, typ: int16}\nlines: {}\n"
    text = f"templates_from: more.yaml\n{HEAD}      p: {{use: t, protocol: vigor, station: 1}}\n"
    place = "templates.t.tags.a.typ"
    assert mistakes(tmp_path, text, more=more) == [
        f"more.yaml:4: {place}: used by p in line 8: no setting of a tag: did you mean type?",
        "more.yaml:5: lines: a file of templates has `templates:` only",
    ]


@pytest.mark.parametrize(
    ("device", "sentence"),
    [
        ("{use: pump, station: 3}", "p: missing: template pump needs base"),
        ("{use: pmp, station: 3}", "p.use: there is no template pmp: did you mean pump?"),
        (
            "{use: x, station: 3}",
            "p.use: there is no template x: the file has pump; docs/templates.md has those",
        ),
        ("{use: 5, station: 3}", "p.use: 5 is no name of a template"),
        (
            "{use: pump, base: 1, station: 3, bas: 2}",
            "p.bas: no parameter of pump, and no setting of a vigor device: did you mean base?",
        ),
        ("{use: pump, base: {base}, station: 3}", "p.base: a mapping is no value: write a number"),
        ("{use: pump, base: null, station: 3}", "p.base: nothing is no value: write a number"),
        ("{use: pump, base: 1, repeat: 3}", "p.repeat: the name needs the number too: p-{n}"),
        ("{use: pump, base: 1, repeat: 0}", "p.repeat: 0 is no count from 1 to 10000"),
        ("{use: pump, base: 1, repeat: x}", "p.repeat: 'x' is no count from 1 to 10000"),
        (
            '{use: pump, base: 1, station: "{n}"}',
            "p.station: {n}: n is no parameter here: use base or valves",
        ),
        (
            "{use: pump, base: D5, station: 3}",
            "templates.pump.tags.flow.address: used by p in line 16: {base + 1}: 'D5' is no whole",
        ),
        (
            "{use: [pump, other], base: 1, station: 3}",
            "templates.other.tags: used by p in line 19: a tag flow is in template pump already",
        ),
        (
            "{use: [pump, round], base: 1, station: 3}",
            "templates use each other without end: round uses square uses round",
        ),
    ],
)
def test_mistakes_of_a_device(tmp_path: Path, device: str, sentence: str) -> None:
    more = ""
    if "[" in device:
        more = '  other: {tags: {flow: {address: "D5"}}}\n  round: {use: square}\n'
        more += "  square: {use: round}\n"
    found = mistakes(tmp_path, f"{PUMP}{more}{HEAD}      p: {device}\n")
    assert any(sentence in message for message in found), found


@pytest.mark.parametrize(
    ("template", "sentence"),
    [
        ("5", "templates.t: 5 stands where settings are expected"),
        ("{parameters: 5}", "templates.t.parameters: 5 stands where parameters are expected"),
        ("{parameters: [a-b]}", "templates.t.parameters.a-b: a-b: a parameter has letters"),
        ("{parameters: [n]}", "templates.t.parameters.n: n has a meaning of its own"),
        (
            "{parameters: {at: 1}, tags: {a: {address: {at}}}}",
            '{at} without quotes is a mapping in YAML: write "{at}"',
        ),
        ('{tags: {a: {repeat: 2, address: "D1"}}}', "the name needs the number too: a-{i}"),
        ('{tags: {a: {address: "D{"}}}', "a { stands alone: write {{ for the character"),
        ('{tags: {a: {address: "D{1 +}"}}}', "{1 +} is no expression such as base + 2*n"),
        ('{tags: {a: {address: "D{__import__(1)}"}}}', "use whole numbers, parameters, + - * //"),
        ('{tags: {a: {address: "D{1//0}"}}}', "{1//0} divides by 0"),
        ('{tags: {a: {address: "D{9**9**9}"}}}', "use whole numbers, parameters, + - * //"),
        ('{tags: {a: {address: "D{99999 * 99999}"}}}', "9999800001 is beyond 1000000000"),
        (f'{{tags: {{a: {{address: "D{{{"1+" * 100}1}}"}}}}}}', "has no expression such as base"),
        ('{tags: {a: {address: "D{1:wide}"}}}', "'wide' is no form such as 04"),
        (
            '{tags: {"a-{i}": {repeat: 9999, address: "D{i}"}, "b-{i}": {repeat: 99999}}}',
            "99999 is no count from 1 to 10000",
        ),
        # The device has tags and defaults of its own.
        ("{tags: [1]}", "templates.t.tags: used by p in line 9: a list stands where settings"),
        ("{defaults: 5}", "templates.t.defaults: used by p in line 9: 5 stands where settings"),
        (
            "{defaults: {tags: {a: 1}}}",
            "templates.t.defaults.tags: used by p in line 9: no setting",
        ),
    ],
)
def test_mistakes_of_a_template(tmp_path: Path, template: str, sentence: str) -> None:
    text = f"templates:\n  t: {template}\n{HEAD}"
    text += "      p: {use: t, protocol: vigor, station: 1, defaults: {every: 1s},\n"
    text += "        tags: {x: {address: D5}}}\n"
    found = mistakes(tmp_path, text)
    assert any(sentence in message for message in found), found


def test_templates_that_repeat_without_end_are_a_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.config.templates.expand._MOST_PARTS", 100)
    device = "      p: {use: pump, base: 1, valves: 1000, station: 3}\n"
    found = mistakes(tmp_path, f"{PUMP}{HEAD}{device}")
    assert any("repeat without end: use a smaller `repeat`" in message for message in found)


def test_expressions() -> None:
    values = {"base": 100, "name": "D", "n": 3}
    for text, expected in {
        "{base}": 100,
        "{name}{base + 2*n}": "D106",
        "{-(n - 5)}": 2,
        "{n:03}": "003",
        "X{base//8*10 + base%8:o}": "X174",
        "{{{n}}}": "{3}",
        "none": "none",
        "{name}": "D",
    }.items():
        assert filled(text, values) == expected


@settings(max_examples=30)
@given(st.text(max_size=30))
def test_any_text_is_filled_or_refused_with_a_sentence(text: str) -> None:
    with suppress(ConfigError):
        filled(f"{{{text}}}", {"a": 1, "b": "x"})


@settings(max_examples=30)
@given(
    st.dictionaries(
        st.text(min_size=1, max_size=5),
        st.one_of(st.text(max_size=8), st.integers(), st.booleans(), st.none()),
        max_size=4,
    )
)
def test_what_is_printed_is_read_as_the_same_data(data: dict[str, Any]) -> None:
    file = YamlFile("x", dumped({"top": data}), frozenset())
    found = Mistakes(file)
    file.read(found)
    assert (file.data, len(found)) == ({"top": data}, 0)


def test_the_example_is_good() -> None:
    config = load(Path(__file__).parents[2] / "examples" / "templates" / "plant.yaml")
    assert [device.name for device in config.devices] == [
        *(f"pump-{n}" for n in range(1, 13)),
        "mixer",
    ]


def test_the_command_prints_a_file_by_itself(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(f"{PUMP}{HEAD}      p: {{use: pump, base: 100, station: 3}}\n")
    done = command("check", path, "--expand")
    assert (done.code, done.out) == (0, EXPANDED)
    path.write_text(f"{PUMP}{HEAD}      p: {{use: pump, station: 3}}\n")
    wrong = command("check", path, "--expand")
    assert (wrong.code, "missing: template pump needs base" in wrong.err) == (2, True)


# -- the shipped templates -----------------------------------------------------------------------


def shipped(folder: Path, use: str, device: str) -> dict[str, Tag]:
    """The tags of a device by their address; each address is there once."""
    path = folder / "plant.yaml"
    path.write_text(
        f"lines:\n  hall:\n    port: simulator\n    devices:\n      p: {{use: {use}, {device}}}\n"
    )
    found = load(path).devices[0].tags
    assert len({tag.text for tag in found}) == len(found)
    return {tag.text: tag for tag in found}


VIGOR = "protocol: vigor, station: 1"
K120S = "protocol: modbus-rtu, addressing: k120s, station: 1"
DEVICES = {"liyan": "protocol: computer-link, station: 1", "k120s": K120S}


@pytest.mark.parametrize(
    ("use", "expected"),
    [
        ("vigor/cpu-link", manual.CPU_LINK),
        ("vigor/parallel-link", manual.PARALLEL_LINK),
        ("vigor/rs", manual.RS),
        ("vigor/modem", manual.MODEM),
        ("vigor/cp2", {"D9121": "station number"}),
        ("vigor/display", manual.DISPLAY),
        ("liyan/computer-link", manual.LIYAN),
        ("k120s/flags", manual.K120S_FLAGS),
    ],
)
def test_relays_and_registers_are_those_of_the_manual(
    tmp_path: Path, use: str, expected: dict[str, str]
) -> None:
    found = shipped(tmp_path, use, DEVICES.get(use.partition("/")[0], VIGOR))
    assert set(found) == set(expected)
    for address, words in expected.items():
        text = f"{found[address].name} {found[address].label.description}".lower().replace("-", " ")
        missing = [word for word in words.replace("-", " ").split() if word not in text]
        assert not missing, (address, text)
        slave = re.search(r"slave (\d)", words)
        assert not slave or found[address].name.endswith(f"slave-{slave[1]}")


def ranges(text: str) -> list[str]:
    """`D0-3 M1000-1001` as single addresses."""
    return [
        f"{part[0]}{number}"
        for part in text.split()
        for number in range(int(part[1:].split("-")[0]), int(part.split("-")[1]) + 1)
    ]


@pytest.mark.parametrize("mode", [1, 2, 3])
def test_data_of_cpu_link_are_those_of_the_manual(tmp_path: Path, mode: int) -> None:
    found = shipped(tmp_path, f"vigor/cpu-link-mode-{mode}", VIGOR)
    expected = {
        address: f"cpu-link/station-{station}/{address}"
        for station, text in enumerate(manual.CPU_LINK_DATA[mode])
        for address in ranges(text)
    }
    assert {address: tag.name for address, tag in found.items()} == expected
    three = shipped(tmp_path, f"vigor/cpu-link-mode-{mode}", f"{VIGOR}, stations: 3")
    assert set(three) == {a for text in manual.CPU_LINK_DATA[mode][:3] for a in ranges(text)}


@pytest.mark.parametrize("mode", [1, 2, 3])
def test_a_cpu_link_with_a_ninth_station_is_refused(tmp_path: Path, mode: int) -> None:
    """The registers behind those of the eighth belong to the program of the PLC."""
    for stations in (0, 9, 17, 18, 1000):
        with pytest.raises(ConfigErrors, match="is no count from 1"):
            shipped(tmp_path, f"vigor/cpu-link-mode-{mode}", f"{VIGOR}, stations: {stations}")


@pytest.mark.parametrize("speed", ["normal", "high-speed"])
def test_data_of_parallel_link_are_those_of_the_manual(tmp_path: Path, speed: str) -> None:
    found = shipped(tmp_path, f"vigor/parallel-link-{speed}", VIGOR)
    to_slave, to_master = map(ranges, manual.PARALLEL_LINK_DATA[speed])
    assert set(found) == {*to_slave, *to_master, *manual.PARALLEL_LINK}
    assert all(found[address].name.startswith("parallel-link/to-slave/") for address in to_slave)
    assert all(found[address].name.startswith("parallel-link/to-master/") for address in to_master)


def parts(folder: Path, use: str, device: str) -> dict[str, tuple[str, dict[int, str]]]:
    """Address, byte and names of the values of each tag."""
    path = folder / "plant.yaml"
    line = f"{{port: simulator, devices: {{p: {{use: {use}, {device}}}}}}}"
    path.write_text(f"lines: {{hall: {line}}}\n")
    return {
        tag.name: (tag.text, {} if tag.shaping.names is None else dict(tag.shaping.names.by_number))
        for tag in load(path).devices[0].tags
    }


def same(found: dict[int, str], expected: dict[int, str]) -> bool:
    """True if all numbers have their words."""
    return found.keys() == expected.keys() and all(
        words in found[code].lower() for code, words in expected.items()
    )


def test_codes_have_the_words_of_the_manual(tmp_path: Path) -> None:
    link = parts(tmp_path, "vigor/cpu-link", VIGOR)
    for slave in range(1, 8):
        address, names = link[f"cpu-link/error-code/slave-{slave}"]
        assert (address, same(names, manual.CPU_LINK_CODES)) == (f"D{9211 + slave}", True)
    for use in ("easy-link", "mbus"):
        found = parts(tmp_path, f"vigor/{use}", f"{VIGOR}, status: 100")
        assert found[f"{use}/status"][0] == found[f"{use}/station"][0] == "D100"
        assert same(found[f"{use}/status"][1], manual.LINK_CODES)
        assert found[f"{use}/done"][0] == "M9199"
    for name, codes in (("modcom", manual.MODCOM_CODES), ("dsnd", manual.DSND_CODES)):
        found = parts(tmp_path, f"k120s/{name}", f"{K120S}, status: D0110")
        assert (found[f"{name}/done"][0], found[f"{name}/error"][0]) == ("D0110.0", "D0110.1")
        assert found[f"{name}/code"][0] == "D0110"
        assert same(found[f"{name}/code"][1], codes)
    display = parts(tmp_path, "vigor/display", VIGOR)
    assert same(display["display/mode"][1], manual.DISPLAY_MODES)
    link = parts(tmp_path, "liyan/computer-link", DEVICES["liyan"])
    assert same(link["computer-link/error-code"][1], manual.LIYAN_CODES)
    module = parts(tmp_path, "vigor/vb-1com", f"{VIGOR}, status: 28, error: 29")
    assert module["vb-1com/error-code"][0] == "D29"
    assert same(module["vb-1com/error-code"][1], manual.VB_1COM_CODES)


def test_the_status_of_drcv_has_the_length_of_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    device = f"{{use: k120s/drcv, {K120S}, status: M010}}"
    path.write_text(f"lines: {{hall: {{port: simulator, devices: {{p: {device}}}}}}}\n")
    found = {tag.name: tag.decode([0x0501]) for tag in load(path).devices[0].tags}
    assert found == {"drcv/done": True, "drcv/error": False, "drcv/length": 5}


def test_a_status_word_is_read_as_the_manual_divides_it(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    device = f"{{use: vigor/easy-link, {VIGOR}, status: 100}}"
    path.write_text(f"lines: {{hall: {{port: simulator, devices: {{p: {device}}}}}}}\n")
    found = {tag.name: tag.decode([0x0A07]) for tag in load(path).devices[0].tags[:2]}
    assert found == {"easy-link/status": 10, "easy-link/station": 7}


def words_of_bits(found: dict[str, Tag]) -> dict[int, str]:
    return {int(a.split(".")[1]): tag.label.description for a, tag in found.items() if "." in a}


def test_ex485lnk(tmp_path: Path) -> None:
    link = "protocol: computer-link, station: 1, status: D0200, error: D0201"
    found = shipped(tmp_path, "ex485lnk/status", link)
    assert same(words_of_bits(found), manual.EX485LNK_STATUS)
    module = shipped(tmp_path, "vigor/vb-1com", f"{VIGOR}, status: 28, error: 29")
    assert same(words_of_bits(module), manual.VB_1COM_STATUS)
    slave = "protocol: modbus-rtu, addressing: ex485lnk, station: 1, read: 0, written: 10"
    assert set(shipped(tmp_path, "ex485lnk/slave", f"{slave}, read_words: 2")) == {
        "holding:0",
        "holding:1",
        "holding:10",
    }


def _names() -> Iterator[str]:
    for file in sorted(SHIPPED.glob("*.yaml")):
        yield from read_yaml(file, frozenset())[0].data["templates"]


def test_every_shipped_template_is_on_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "templates.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| `(\S+/\S+)` \|", page, re.MULTILINE)
    assert table == list(_names())
