"""What each way to a user shows of a value that is no plain reading: the table of the page."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gateway.bridges.documents import is_value
from gateway.bridges.influx.lines import line_of
from gateway.bridges.mqtt.bridge import Bridge
from gateway.bridges.mqtt.sparkplug.messages import Payload
from gateway.bridges.mqtt.sparkplug.metrics import fill
from gateway.bridges.opcua.values import Code, data_value, type_of
from gateway.cli.history.history import _SAMPLES, _row  # a line of a CSV file, without the file
from gateway.cli.tables import row_of, table_of
from gateway.config import load
from gateway.contract import payload
from gateway.contract.documents.catalogue import REASONS
from gateway.contract.meta import meta_fields
from gateway.contract.past import buckets
from gateway.contract.past.buckets import Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.parts.web.events import Page
from gateway.tags import Reason, Sample, Tag, bad, good
from gateway.tags.sample import converted
from tests.history.recorded import EVERYTHING, NOON, SECOND, history

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "provenance.md").read_text("utf-8")
FILE = """
gateway: {name: demo}
zenoh: {prefix: plant, listen: [tcp/127.0.0.1:0]}
history: {path: history.db}
defaults: {history: true}
lines:
  sim:
    port: simulator
    devices: {a: {protocol: vigor, station: 1, tags: {simulated: {address: D1}}}}
  log:
    port: tcp://127.0.0.1:4001
    origin: replayed
    devices: {r: {protocol: vigor, station: 1, tags: {replayed: {address: D1}}}}
  panel:
    port: /dev/ttyS1
    serve: true
    devices: {p: {protocol: vigor, station: 1, tags: {held: {address: D1, write: true}}}}
  hall:
    port: /dev/ttyS0
    devices:
      b:
        protocol: vigor
        station: 1
        tags:
          plain: {address: D1}
          computed: {computed: plain * 2}
          counted: {address: D2, counter: true}
          clamped: {address: D2, clamp: [0, 100]}
          ranged: {address: D2, range: [0, 50]}
          half: {address: D3, clamp: [null, 100]}
          steps: {address: "D4", type: "int16[2]", clamp: [0, 100]}
"""


@pytest.fixture
def tags(tmp_path: Path) -> dict[str, Tag]:
    (tmp_path / "plant.yaml").write_text(FILE)
    devices = load(tmp_path / "plant.yaml").devices
    return {tag.name: tag for device in devices for tag in device.tags}


def shown(sample: Sample, folder: Path) -> dict[str, str]:
    """What the ways show beside the value, as the page has it."""
    tag = sample.tag
    with history(folder / f"{tag.name}-{sample.quality}.db") as historian:
        historian.record([sample])
        [past] = historian.samples(tag, EVERYTHING, None)
        asked, now = HistoryQuery(EVERYTHING, bucket=SECOND), Now(NOON + 1, is_valid=True)
        [bucket] = historian.buckets(tag, asked, now, lambda: None)
    known = json.loads(payload.value(sample))
    table = table_of([row_of(sample)], {})
    [quality] = table.columns[3].cells
    names = [column.name for column in _SAMPLES]
    return {
        "value, block, JSON API": _about(known),
        "past values": _about(json.loads(payload.value(past))),
        "bare value: attachment": _about(json.loads(payload.attachment(sample))),
        "bucket": _about(buckets.fields(tag, bucket, ["last"])),
        "`@meta`": _about(meta_fields(tag)),
        "`read`, `watch`": str(quality),
        "page": _of_page(sample),
        "CSV": _about(dict(zip(names, _row(past), strict=True))),
        "MQTT": _about(_of_mqtt(tag, known)),
        "Sparkplug B": _of_sparkplug(tag, known),
        "OPC UA": _of_opcua(tag, known),
        "InfluxDB": ", ".join(
            part.replace('"', "").replace("=", ": ")
            for part in re.split("[ ,]", line_of(tag.key, known))
            if part.startswith(("origin", "limited", "good=false"))
        ),
    }


def _of_opcua(tag: Tag, known: dict[str, Any]) -> str:
    code = data_value(known, type_of(meta_fields(tag))).StatusCode.value
    names = {
        getattr(Code, name): name
        for name in (
            *("Good", "GoodEdited", "GoodLocalOverride"),
            *("UncertainEngineeringUnitsExceeded", "BadConfigurationError"),
        )
    }
    bits = {0: "", 0x500: ", limit bits low", 0x600: ", limit bits high"}
    return names[code & 0xFFFF0000] + bits[code & 0xFFFF]


def _of_page(sample: Sample) -> str:
    core: Any = SimpleNamespace(plant=SimpleNamespace(sample=lambda _: sample))
    page = Page(core, core, [sample.tag], None)
    [[_, _, quality, _, why, _]] = page._values([sample.tag])  # without a server and its events
    return str(why) if quality == "good" else f"{quality}: {why}"


def _of_mqtt(tag: Tag, known: dict[str, Any]) -> Any:
    bridge = Bridge("plant", expire=0, commands=None)
    plant: Any = SimpleNamespace(tags={tag.key: meta_fields(tag)})
    bridge.plant = plant
    bridge.changed(tag.key, known)
    [document] = bridge._retained.values()  # what the broker would get
    return json.loads(document)


def _of_sparkplug(tag: Tag, known: dict[str, Any]) -> str:
    metric = Payload().metrics.add()
    fill(metric, known, meta_fields(tag))
    found = dict(zip(metric.properties.keys, metric.properties.values, strict=True))
    quality = found.pop("Quality").int_value
    about = [f"{name}: {one.string_value}" for name, one in found.items() if name != "Reason"]
    return ", ".join([*about, *([] if quality == 192 else [f"quality {quality}"])])


def _about(document: dict[str, Any]) -> str:
    found = [f"{name}: {document[name]}" for name in ("origin", "limited") if document.get(name)]
    quality = document.get("quality", "good")
    return ", ".join(found if quality == "good" else [*found, quality])


def test_the_table_of_the_page_is_what_each_way_shows(tags: dict[str, Tag], tmp_path: Path) -> None:
    origins = ("simulated", "replayed", "held", "computed")
    ends = {"clamped": 100, "ranged": 51, "swapped": 7}
    values = {"plain": 7, **dict.fromkeys((*origins, "counted"), 7), **ends}
    samples = {
        name: good(tags[name], value, NOON)
        if tags[name].origin.inputs
        else converted(tags[name], value, NOON)
        for name, value in values.items()
        if name != "swapped"
    } | {"swapped": bad(tags["plain"], Reason.WRONG_DEVICE, NOON)}
    found = {name: shown(sample, tmp_path) for name, sample in samples.items()}
    rows = [
        f"| {way} | {' | '.join(found[name][way] or '–' for name in columns)} |"
        for columns in (("plain", *origins), ends)
        for way in found["plain"]
    ]
    lines = PAGE.partition("## An uncertain value")[0].splitlines()
    ways = tuple(f"| {way} |" for way in found["plain"])
    assert [line for line in lines if line.startswith(ways)] == rows
    assert found["counted"] == found["computed"]

    def silent(name: str) -> set[str]:
        return {way for way, text in found[name].items() if text in ("", "good", "Good")}

    assert [silent(name) for name in origins] == [set(), set(), set(), {"OPC UA"}]
    assert silent("ranged") == silent("swapped") == {"`@meta`"}


@pytest.mark.parametrize(
    ("name", "value", "limited"),
    [
        ("clamped", 0, "low"),
        ("clamped", 1, None),
        ("clamped", 99, None),
        ("clamped", 100, "high"),
        ("half", -32768, None),
        ("half", 100, "high"),
        ("steps", (1, 99), None),
        ("steps", (5, 0), "low"),
        ("plain", 0, None),
    ],
)
def test_a_value_at_an_end_of_its_clamp_is_limited(
    tags: dict[str, Tag], name: str, value: Any, limited: str | None
) -> None:
    assert json.loads(payload.value(good(tags[name], value, NOON))).get("limited") == limited


def test_a_read_outside_of_the_clamp_is_limited(tags: dict[str, Tag]) -> None:
    for word, value, limited in ((0xFFFF, 0, "low"), (50, 50, None), (300, 100, "high")):
        known = tags["clamped"].decode([word])
        assert known == value
        assert tags["clamped"].shaping.limited(known) == limited


def test_a_bridge_takes_an_uncertain_value_only_with_its_reason() -> None:
    known = {"value": 7, "quality": "uncertain", "time": "2026-11-20T12:00:00Z"}
    assert [is_value(known | more) for more in ({}, {"reason": "out-of-range"})] == [False, True]


def test_a_bad_value_is_not_limited(tags: dict[str, Tag]) -> None:
    known = json.loads(payload.value(bad(tags["clamped"], Reason.NO_REPLY, NOON)))
    assert "limited" not in known


def test_every_reason_has_codes() -> None:
    assert set(REASONS) == set(Reason)
    assert {signal for _, signal in REASONS.values()} <= set("FCSM")
