"""The configuration of no-protocol devices: what it becomes, and what is said of its mistakes."""

import json
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from gateway.config import Config, ConfigErrors, load, schema
from gateway.engine.device.device import Device
from gateway.protocols.driver import Address, Cost, Span
from gateway.protocols.frames import FrameDriver
from gateway.tags import Publish, WriteRule
from gateway.values import Kind
from tests.protocols.frames_examples import documented
from tests.schema_check import violations

FOLDER = Path(__file__).parents[2] / "examples"
OTHERS = {FOLDER / name for name in ("panel.yaml", "fx.yaml")}  # of other protocols
EXAMPLES = sorted(set(FOLDER.glob("*.yaml")) - OTHERS)
M = "lines.hall.devices.scale"


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Config]:
    """Loads a text as `plant.yaml`."""
    monkeypatch.chdir(tmp_path)

    def loaded(text: str) -> Config:
        Path("plant.yaml").write_text(text, encoding="utf-8")
        return load("plant.yaml")

    return loaded


def on_line(rows: str) -> str:
    """A file with one line `hall`; `rows`, its devices, begin in line 5."""
    return "lines:\n  hall:\n    port: /dev/ttyS1\n    devices:\n" + textwrap.indent(
        textwrap.dedent(rows), "      "
    )


SCALE = """\
scale:
  protocol: frames
  framing: {ending: CR LF, max_length: 32, gap: 50ms}
  listen:
    weighing:
      match: '(?P<state>ST|US),(?P<weight>[+-][0-9.]{8})'
      fields: {weight: {type: decimal}, state: {type: text}}
      stale_after: 2s
  ask:
    version:
      send: "V?"
      match: 'V(?P<version>[0-9]{3}),(?P<hours>[0-9]{1,6})'
      fields: {version: {type: integer}, hours: {type: integer}}
  write:
    tare: {send: "T{value}", value: {type: decimal, format: 06.2f}, match: OK}
  tags:
"""


def scale(*rows: str) -> str:
    """The scale with these tags, which begin in line 21."""
    return on_line(SCALE + "".join(f"    {row}\n" for row in rows))


def test_a_device_of_frames_is_a_driver_like_any_other(file: Callable[[str], Config]) -> None:
    config = file(
        scale(
            "weight:  {address: weight, unit: g, scale: 0.001, deadband: 2%, event: true}",
            "state:   {address: state, history: false}",
            "hours:   {address: hours, every: 1min}",
            "version: {address: version}",
            "tare:    {address: tare, write: {min: 0, max: 10}}",
        )
    )
    (line,) = config.lines
    (device,) = line.devices
    driver = device.driver
    assert isinstance(driver, FrameDriver)
    assert (line.serial.baudrate, line.serial.format) == (9600, "8N1")
    assert driver.settings.framing.gap == 0.05
    assert driver.settings.listen["weighing"].stale_after == 2.0
    weight, state, hours, version, tare = device.tags
    assert (weight.publishing.event, weight.publishing.publish, weight.layout.type.kind) == (
        True,
        Publish.ALWAYS,
        Kind.FLOAT64,
    )
    assert state.layout.type.kind is Kind.STRING
    assert (hours.address, version.address) == (
        Address("ask version", 1),
        Address("ask version", 0),
    )
    assert tare.write == WriteRule(min=0, max=10)
    # The whole reply comes, however little of it is wanted.
    whole = Cost(4, 13)
    for span in (version.span, hours.span, Span("ask version", 0, 2)):
        assert driver.cost(span) == whole
    assert driver.cost(weight.span) is None
    assert driver.write_cost(hours.span) is None
    assert driver.write_cost(tare.span) == Cost(9, 4)
    for tag in device.tags:
        assert driver.address(driver.spell(tag.address)) == tag.address


def test_all_fields_of_a_reply_share_one_request(file: Callable[[str], Config]) -> None:
    config = file(
        scale("hours: {address: hours, every: 1min}", "version: {address: version, every: 1s}")
    )
    device = Device(config.devices[0], config.lines[0].wire)
    (block,) = device.blocks
    assert block.every == 1.0
    assert {tag.name for tag in block.tags} == {"hours", "version"}


MISTAKES = {
    "no such field": (
        scale("a: {address: wieght}"),
        (
            f"21: {M}.tags.a.address: 'wieght' is no field of this device: "
            "it has hours, state, tare, version, weight"
        ),
    ),
    "what the field says already": (
        scale("a: {address: weight, type: int16, byte_order: low_first}"),
        f"21: {M}.tags.a.type: the field weight has its own type: remove type here",
        f"21: {M}.tags.a.byte_order: the field weight has its own type: remove byte_order here",
    ),
    "a text has no scale": (
        scale("a: {address: state, scale: 2}"),
        f"21: {M}.tags.a.scale: a string[250] has no scale: only numbers have",
    ),
    "nothing to write it with": (
        scale("a: {address: weight, write: true}"),
        (
            f"21: {M}.tags.a.write: weight cannot be written: the device has no frame for it, "
            "`write: {weight: ...}`"
        ),
    ),
    "only written": (
        scale("a: {address: tare}"),
        f"21: {M}.tags.a.write: tare can only be written: it needs write: true",
    ),
    "nothing to read it back with": (
        scale("a: {address: tare, write: {verify: true}}"),
        f"21: {M}.tags.a.write: tare cannot be read back, no request reads it: remove verify",
    ),
    "a bound that does not fit": (
        scale("a: {address: tare, write: {max: 10000}}"),
        f"21: {M}.tags.a.write.max: 10000.0 does not fit 6 characters",
    ),
    "an event that is polled": (
        scale("a: {address: hours, event: true}"),
        f"21: {M}.tags.a.event: hours never arrives unsolicited: events are fields under `listen`",
    ),
    "an interval for what comes by itself": (
        scale("a: {address: weight, every: 1s}"),
        f"21: {M}.tags.a.every: weight is never polled: it has no interval",
    ),
    "an event of a PLC": (
        on_line("plc: {protocol: vigor, station: 1, tags: {a: {address: D1, event: true}}}"),
        (
            "5: lines.hall.devices.plc.tags.a.event: D1 is polled: "
            "only an unsolicited value can be an event"
        ),
    ),
    "unknown settings, however deep": (
        scale("a: {address: weight}").replace("ending:", "endng:").replace("format:", "fromat:"),
        f"7: {M}.framing.endng: no setting of framing: did you mean ending?",
        f"19: {M}.write.tare.value.fromat: no setting of value: did you mean format?",
    ),
    "durations without a unit": (
        scale("a: {address: weight}")
        .replace("gap: 50ms", "gap: 50")
        .replace("stale_after: 2s", "stale_after: 2"),
        f"7: {M}.framing.gap: 50 has no unit: write 50s or 50ms",
        f"12: {M}.listen.weighing.stale_after: 2 has no unit: write 2s or 2ms",
    ),
    "what is missing": (
        scale("a: {address: weight}").replace("{type: text}", "{}"),
        f"11: {M}.listen.weighing.fields.state.type: missing: state needs it",
    ),
    "no framing": (
        on_line("scale: {protocol: frames, listen: {a: {}}}"),
        f"5: {M}.framing: missing: a frames device needs it",
    ),
    "another type": (
        scale("a: {address: weight}").replace("max_length: 32", "max_length: long"),
        f"7: {M}.framing.max_length: 'long' is no whole number",
    ),
    "no settings": (
        scale("a: {address: weight}").replace("{type: text}", "text"),
        (
            f"11: {M}.listen.weighing.fields.state: 'text' stands where settings are expected, "
            "each as `name: value`"
        ),
    ),
    "a preset's own rule": (
        on_line(
            """\
            scale:
              protocol: frames
              framing: {preset: vb-1com, format: 2, terminator: "AB"}
              listen: {a: {}}
            """
        ),
        f"7: {M}.framing: error 9: the first byte of terminator 'AB' is not 01h..1Fh",
    ),
    "a simulated one": (
        scale("a: {address: weight}").replace("/dev/ttyS1", "simulator"),
        "3: lines.hall.port: scale cannot be simulated: there is no station for frames",
    ),
    "two that send unsolicited frames": (
        on_line(
            """\
            one: {protocol: frames, framing: {ending: CR}, listen: {a: {}}}
            two: {protocol: frames, framing: {ending: CR}, listen: {a: {}}}
            """
        ),
        (
            "6: lines.hall.devices.two.listen: one on this line sends unsolicited frames already, "
            "and a frame does not say which device sent it: give this device a line of its own, "
            "or write both as one device"
        ),
    ),
    "defaults that differ": (
        on_line(
            """\
            a: {protocol: vigor, station: 1}
            b: {protocol: frames, framing: {ending: CR}, ask: {a: {send: A, match: '(?P<b>.)',
              fields: {b: {type: text}}}}}
            """
        ),
        (
            "2: lines.hall.baudrate: missing: the devices of this line differ in it "
            "(vigor 19200, frames 9600)"
        ),
        (
            "2: lines.hall.format: missing: the devices of this line differ in it "
            "(vigor 7E1, frames 8N1)"
        ),
    ),
}


@pytest.mark.parametrize("case", MISTAKES.values(), ids=list(MISTAKES))
def test_a_mistake_is_reported_with_line_path_and_a_correct_example(
    case: tuple[str, ...], file: Callable[[str], Config]
) -> None:
    text, *says = case
    with pytest.raises(ConfigErrors) as caught:
        file(text)
    assert list(caught.value.messages) == [f"plant.yaml:{message}" for message in says]


def test_two_polled_devices_and_an_unsolicited_one_may_share_a_line(
    file: Callable[[str], Config],
) -> None:
    asked = "ask: {q: {send: Q, match: '(?P<b>.)', fields: {b: {type: text}}}}"
    config = file(
        on_line(
            f"""\
            a: {{protocol: frames, framing: {{ending: CR}}, {asked}}}
            b: {{protocol: frames, framing: {{header: "<STX>", terminator: "<ETX>"}}, {asked}}}
            c: {{protocol: frames, framing: {{ending: CR}}, listen: {{a: {{}}}}}}
            """
        )
    )
    assert [device.name for device in config.devices] == ["a", "b", "c"]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_load_and_editors_find_nothing_wrong(path: Path) -> None:
    assert load(path).devices
    assert violations(yaml.safe_load(path.read_text("utf-8")), schema()) == []


def test_the_examples_are_the_devices_of_the_page() -> None:
    """Both are read by people; they must not drift apart. Names and intervals may differ."""
    page = documented()
    names = {"as-text": "vigor-as-text", "converted": "vigor-converted"}
    seen = set()
    for path in EXAMPLES:
        for line in yaml.safe_load(path.read_text("utf-8"))["lines"].values():
            for name, device in line["devices"].items():
                same = dict(page[names.get(name, name)])
                assert {**device, "tags": 0} == {**same, "tags": 0}
                assert device["tags"].keys() == same["tags"].keys()
                seen.add(names.get(name, name))
    assert seen == set(page) - {"scale-by-columns"}


def test_an_editor_shows_mistakes_in_frames() -> None:
    text = on_line(SCALE).replace("gap: 50ms", "gap: 50").replace("send:", "sned:")
    found = violations(yaml.safe_load(text), schema())
    device = "/lines/hall/devices/scale"
    assert f"{device}/framing/gap" in found
    assert any(place.startswith(f"{device}/ask/version") for place in found)
    assert json.dumps(schema())
