"""A value that is no plain reading of a device never looks like one, whichever way it takes."""

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.tables import row_of
from gateway.config import Config, load
from gateway.config.changes import compare
from gateway.contract import payload
from gateway.contract.meta import meta_fields
from gateway.contract.past import buckets
from gateway.contract.past.buckets import Bucket
from gateway.contract.payload import WriteOutcome
from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import Write
from gateway.engine.results.request_rules import result_of
from gateway.tags import Reason, Tag, bad, good
from tests.conftest import Command
from tests.history.recorded import EVERYTHING, NOON, history

FILE = """
gateway: {{name: demo}}
zenoh: {{prefix: plant, listen: [tcp/127.0.0.1:0]}}
history: {{path: history.db}}
lines:
  hall:
    port: {port}
    devices:
      mixer:
        protocol: vigor
        station: 1
        defaults: {{history: true}}
        tags:
          speed: {{address: D1, write: true}}
          mode: {{address: D2, enum: {{0: idle, 1: runs}}}}
          starts: {{address: D3, counter: true}}
          raw: {{address: D4, payload: raw}}
          double: {{computed: speed * 2}}
"""


def config_of(folder: Path, port: str) -> Config:
    (folder / "plant.yaml").write_text(FILE.format(port=port))
    return load(folder / "plant.yaml")


def tags_of(config: Config) -> Mapping[str, Tag]:
    return {tag.name: tag for tag in config.lines[0].tags}


def paths(tag: Tag) -> Mapping[str, Any]:
    """The documents of one value, by the way to its user."""
    sample = good(tag, 1, NOON)
    bucket = Bucket(NOON, NOON, NOON + 1, 1, 1, 0, 1, 1, 1.0, 1, None)
    return {
        "value": json.loads(payload.value(sample)),
        "bad value": json.loads(payload.value(bad(tag, Reason.NO_REPLY, NOON))),
        "attachment of a raw value": json.loads(payload.attachment(sample)),
        "block": json.loads(payload.block([sample]))[tag.name],
        "description": meta_fields(tag),
        "bucket": buckets.fields(tag, bucket, ["last"]),
        "command line": row_of(sample).document,
    }


@pytest.mark.parametrize("name", ["speed", "mode", "starts", "raw", "double"])
def test_each_way_tells_that_a_value_is_simulated(tmp_path: Path, name: str) -> None:
    tag = tags_of(config_of(tmp_path, "simulator"))[name]
    assert {way: found.get("origin") for way, found in paths(tag).items()} == dict.fromkeys(
        paths(tag), "simulated"
    )


@pytest.mark.parametrize(("name", "origin"), [("speed", None), ("double", "computed")])
def test_a_plain_reading_has_no_origin(tmp_path: Path, name: str, origin: str | None) -> None:
    tag = tags_of(config_of(tmp_path, "/dev/ttyS0"))[name]
    assert {found.get("origin") for found in paths(tag).values()} == {origin}


def test_a_write_to_a_simulated_device_is_not_told_as_a_real_one(tmp_path: Path) -> None:
    config = config_of(tmp_path, "simulator")
    tag = tags_of(config)["speed"]
    device = Device(config.devices[0], config.lines[0].wire)
    result = result_of(Write(device, tag, tag.encode(7), 0.0), 0.1, NOON)
    outcome = WriteOutcome("plant/mixer/speed", 7, result, NOON, 0.1)
    assert json.loads(payload.outcome(result))["origin"] == "simulated"
    assert json.loads(payload.write_outcome(outcome))["origin"] == "simulated"


def test_the_past_of_a_simulated_device_is_not_that_of_the_real_one(
    tmp_path: Path, command: Command
) -> None:
    real = tags_of(config_of(tmp_path, "/dev/ttyS0"))["speed"]
    simulated = tags_of(config_of(tmp_path, "simulator"))["speed"]
    with history(tmp_path / "history.db") as historian:
        historian.record([good(real, 1, NOON), good(simulated, 2, NOON + 1)])
        for tag, value in ((real, 1), (simulated, 2)):
            [found] = historian.samples(tag, EVERYTHING, None)
            assert (found.value, found.tag) == (value, tag)
    file = tmp_path / "out.csv"
    where = ("--time", "[..]", "--output", file)
    assert command("history", "export", tmp_path / "plant.yaml", "mixer/speed", *where).code == 0
    [row] = csv.DictReader(file.read_text().splitlines())
    assert (row["value"], row["origin"]) == ("2", "simulated")


def test_no_value_goes_on_when_a_reload_replaces_the_simulator_by_a_port(tmp_path: Path) -> None:
    old = config_of(tmp_path, "simulator")
    difference = compare(old, config_of(tmp_path, "/dev/ttyS0"))
    assert not difference.renewed
    assert not difference.devices["mixer"].kept
