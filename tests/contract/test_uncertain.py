"""A value outside the range of its sensor: which samples are uncertain, and what each consumer
does with one. No path makes it a good value."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from gateway.cli.history.history import _row  # a line of a CSV file, without the file
from gateway.cli.tables import is_good, row_of, table_of
from gateway.config import Config, built
from gateway.contract import payload
from gateway.contract.past.buckets import Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.parts.alarms.board import Alarms
from gateway.parts.transfers.runner import Transfers
from gateway.parts.transfers.transfer_row import State, TransferRow
from gateway.parts.web import metrics
from gateway.stations.served.registers import Registers
from gateway.stations.store import Denied
from gateway.tags import Quality, Reason, Sample, Tag
from gateway.tags.mirror import Mirror
from gateway.tags.sample import converted, has_value, of_field
from gateway.tags.scan import Decoder, Scan
from gateway.tags.transfer import TransferRule
from tests.config.test_shaping import float_words
from tests.history.recorded import EVERYTHING, NOON, SECOND, history
from tests.northbound.plant import PlainDevice, PlainPlant
from tests.web.serving import PlainNorth

LEVEL: dict[str, Any] = {"address": "D1", "from": [4000, 20000], "to": [0, 100]}
ENDS = {"range": [-1.25, 103.125]}  # 3.8 and 20.5 mA: NAMUR NE 43
TAGS: dict[str, Any] = {
    "level": LEVEL | ENDS | {"alarm": {"high": 90, "low": 10}, "history": True},
    "shown": LEVEL | ENDS | {"clamp": [0, 100]},
    "heat": {"address": "D2", "type": "float32", "range": [None, 150]},
    "both": {"address": "D1", "type": "int16[2]", "range": [0, None]},
    "mode": {"address": "D1", "enum": {"0": "off", "1": "auto"}, "range": [0, 1]},
    "twice": {"computed": "level * 2"},
    "half": {"computed": "shown / 2", "range": [0, 40]},
    "ratio": {"computed": "level / 0"},
}
PANEL: dict[str, Any] = {
    "first": {"address": "D1", "source": "mixer/level", "type": "float32"},
    "last": {"address": "D3", "source": "mixer/level", "type": "float32", "hold_last": True},
    "set": {"address": "D5", "write": True},
}


def plant() -> Config:
    mixer = {"protocol": "vigor", "station": 1, "tags": TAGS}
    panel = {"protocol": "vigor", "station": 2, "defaults": ENDS, "tags": PANEL}
    lines = {
        "hall": {"port": "/dev/ttyS0", "devices": {"mixer": mixer}},
        "panel": {"port": "/dev/ttyS1", "serve": True, "devices": {"panel": panel}},
    }
    return built({"lines": lines, "gateway": {"state": "s.json"}, "history": {"path": "h.db"}})


@pytest.fixture(scope="module")
def tags() -> Mapping[str, Tag]:
    return {tag.name: tag for device in plant().devices for tag in device.tags}


def sample_of(tag: Tag, *units: int, time: int = NOON) -> Sample:
    return converted(tag, units[0] if tag.single else units, time)


@pytest.mark.parametrize(
    ("name", "units", "value", "quality"),
    [
        ("level", [4000], 0.0, "good"),
        ("level", [3800], -1.25, "good"),  # at the end
        ("level", [3799], -1.25625, "uncertain"),
        ("level", [20501], 103.13125, "uncertain"),
        ("shown", [3800], 0.0, "good"),
        ("shown", [0], 0.0, "uncertain"),  # a broken wire, which the clamp would hide
        ("shown", [20501], 100.0, "uncertain"),
        ("heat", float_words(150.0), 150.0, "good"),
        ("heat", float_words(-1e9), -1e9, "good"),
        ("heat", float_words(150.5), 150.5, "uncertain"),
        ("heat", float_words(float("inf")), None, "bad"),
        ("heat", float_words(float("nan")), None, "bad"),
        ("both", [0, 1], (0, 1), "good"),
        ("both", [1, 0xFFFF], (1, -1), "uncertain"),
        ("mode", [2], 2, "uncertain"),
        ("set", [0xFFFF], -1, "good"),  # no sensor measures a set value
    ],
)
def test_a_value_outside_the_range_of_its_sensor_is_uncertain(
    tags: Mapping[str, Tag], name: str, units: list[int], value: object, quality: str
) -> None:
    known = payload.sample_fields(sample_of(tags[name], *units))
    of_json = value if value is None or isinstance(value, tuple) else pytest.approx(value)
    assert (known["value"], known["quality"]) == (of_json, quality)
    wanted = {"good": None, "uncertain": "out-of-range", "bad": "not-a-number"}
    assert known.get("reason") == wanted[quality]
    assert json.loads(payload.value(sample_of(tags[name], *units)))["quality"] == quality


class Reads:
    """A block of `level` and `shown`, as the line reads it."""

    def __init__(self, *tags: Tag) -> None:
        self.decoder, self.mirror = Decoder(tags, [0] * len(tags)), Mirror(tags, 0)
        self.time = 0
        self.scan: Scan | None = None

    def read(self, unit: int) -> list[tuple[str, object, str]]:
        """Returns what is published."""
        self.time += SECOND
        if self.scan is None:
            scan = self.decoder.first([unit], self.time)
        else:
            scan = self.decoder.after(self.scan, [unit], self.time)
        self.scan = scan
        return [(s.tag.name, s.value, s.quality.value) for s in self.mirror.update(scan)]


def test_a_change_of_the_quality_is_published_although_the_clamp_keeps_the_value(
    tags: Mapping[str, Tag],
) -> None:
    reads = Reads(tags["shown"])
    assert reads.read(4000) == [("shown", 0.0, "good")]
    assert reads.read(3000) == [("shown", 0.0, "uncertain")]
    assert reads.read(2000) == []
    assert reads.mirror[tags["shown"]].quality is Quality.UNCERTAIN
    assert [one.quality for one in reads.mirror.samples()] == [Quality.UNCERTAIN]
    assert reads.read(4000) == [("shown", 0.0, "good")]


def test_a_computed_value_is_uncertain_with_its_input(tags: Mapping[str, Tag]) -> None:
    names = ("level", "shown", "twice", "half", "ratio")
    mirror = Mirror([tags[name] for name in names], 0)

    def after(unit: int) -> dict[str, tuple[object, str, str]]:
        read = [sample_of(tags[name], unit) for name in ("level", "shown")]
        found = mirror.follow(mirror.update(read))
        return {s.tag.name: (s.value, s.quality.value, s.detail) for s in found[2:]}

    assert after(12000) == {
        "twice": (100.0, "good", ""),
        "half": (25.0, "good", ""),
        "ratio": (None, "bad", "division by zero"),
    }
    assert after(20000)["half"] == (50.0, "uncertain", "")  # outside a range of its own
    found = after(0)
    assert found["twice"] == (-50.0, "uncertain", "input level is uncertain")
    assert found["half"] == (0.0, "uncertain", "input shown is uncertain")
    assert mirror[tags["twice"]].reason is Reason.OUT_OF_RANGE


def test_a_field_of_a_frame_is_uncertain_too(tags: Mapping[str, Tag]) -> None:
    assert of_field(tags["level"], 0, NOON).quality is Quality.UNCERTAIN


class Fresh(PlainPlant):
    """A plant whose values were read now."""

    def age(self, tag: Tag) -> float:
        return 0.0


async def test_no_consumer_takes_an_uncertain_value_for_a_good_one(
    tags: Mapping[str, Tag], tmp_path: Path
) -> None:
    level = tags["level"]
    fine, doubtful = sample_of(level, 12000), sample_of(level, 0, time=NOON + SECOND)

    # History: the value is kept, and is in no minimum, mean or export of good values.
    with history(tmp_path / "h.db") as historian:
        historian.record([fine, doubtful])
        assert [*historian.samples(level, EVERYTHING, None)] == [fine, doubtful]
        now = Now(NOON + 2 * SECOND, is_valid=True)
        asked = HistoryQuery(EVERYTHING, bucket=60 * SECOND)
        [bucket] = historian.buckets(level, asked, now, lambda: None)
    assert (bucket.min, bucket.good, bucket.bad, bucket.quality) == (50.0, 1, 1, "partial")
    assert bucket.reason == "out-of-range"
    assert not has_value(doubtful)
    assert _row(doubtful)[2:5] == (-25.0, "uncertain", "out-of-range")

    # Alarms: it raises, and ends none.
    alarms = Alarms([level])
    for sample, state in ((fine, "normal"), (doubtful, "active"), (sample_of(level, 1), "active")):
        alarms.judge([sample])
        assert alarms.entries[level.key].status.state.value == state
    alarms.close()

    # A scan judges as single samples do.
    scanned = Alarms([level])
    reads = Reads(level)
    for unit, state in ((12000, "normal"), (19000, "active"), (100, "active"), (12000, "returned")):
        reads.read(unit)
        assert reads.scan is not None
        scanned.judge(reads.scan)
        assert scanned.entries[level.key].status.state.value == state, unit
    assert scanned.entries[level.key].alarm.quality is Quality.GOOD
    scanned.close()

    # Transfers: it is not carried.
    row = TransferRow(TransferRule(number=1, source="a/n", target="b/n", text=("a n", "b n")), 0.0)
    plain = Fresh(PlainDevice("mixer", (level,)))
    plain.samples[level.key] = doubtful
    reading = Transfers(plain, None, [])._reading(level)  # type: ignore[arg-type]
    assert row.next(reading, 0.0) is None
    verdict = row.verdict(reading)
    assert (verdict.state, verdict.why) == (State.STALE, "a n is uncertain: out-of-range")

    # A served line: its master gets no value, or the last good one.
    given = [fine]
    served = next(one.served for one in plant().devices if one.name == "panel")
    assert served is not None
    registers = Registers(served, lambda _: given[-1])
    half = [*registers.read("D", 3, 2)]
    assert half == float_words(50.0)
    given.append(doubtful)
    assert registers.read("D", 3, 2) == half
    with pytest.raises(Denied):
        registers.read("D", 1, 2)

    # Terminal, metrics.
    assert not is_good(row_of(doubtful))
    [quality] = table_of([row_of(doubtful)], {}).columns[3].cells
    assert str(quality) == "uncertain: out-of-range"
    documents = await PlainNorth().documents(0.0)
    text = metrics.exposition(documents, plain, ready=True).decode()
    counts = {
        one.labels["quality"]: one.value
        for family in text_string_to_metric_families(text)
        for one in family.samples
        if one.name == "plc_gateway_device_tags"
    }
    assert counts == {"good": 0, "uncertain": 1, "bad": 0}

    # A bare value says it beside the value.
    about = json.loads(payload.attachment(doubtful))
    assert (payload.value_text(doubtful), about["quality"]) == (b"-25.0", "uncertain")
