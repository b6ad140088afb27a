"""Metrics for Prometheus: made from the status documents when they are scraped.

An exchange on a line costs nothing more. Names and labels are described in docs/metrics.md.
"""

import platform
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from typing import Any

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector, CollectorRegistry

from gateway.contract.faults import (
    ALARM_STATES,
    Documents,
    below,
    faults,
    transfers,
    warnings,
)
from gateway.contract.interfaces import Plant
from gateway.contract.line_faults import stands_by
from gateway.engine.device.records import COMPLETE
from gateway.tags import Quality

CONTENT_TYPE = CONTENT_TYPE_LATEST
STATES = ("starting", "up", "failing", "silent")
_PREFIX = "plc_gateway_"
_BUILD = {"python": platform.python_version(), "zenoh": version("eclipse-zenoh")}

# (name, field, meaning): counters end with `_total`.
_LINE = (
    ("line_opened_total", "opened", "Times that the port was opened"),
    ("line_open_seconds_total", "open_time", "Seconds that the port was open"),
    ("line_busy_seconds_total", "busy_time", "Seconds in which the wire was used"),
    ("line_unasked_bytes_total", "unasked_bytes", "Bytes that belong to no request"),
)
DEVICE = (
    ("device_exchanges_total", "exchanges", "Requests with a reply"),
    ("device_writes_total", "writes", "Writes that reached the device"),
    ("device_retries_total", "retries", "Failed reads that were repeated"),
    ("device_late_replies_total", "late_replies", "Replies after the time-out"),
    ("device_stray_frames_total", "unasked_frames", "Frames that belong to no request"),
    ("device_overruns_total", "overruns", "Polls left out because the one before was late"),
    ("device_overdue_total", "overdue", "Blocks whose values turned bad by age"),
    ("device_wire_seconds_total", "wire_time", "Seconds of the wire that the device used"),
    ("device_turnaround_seconds", "turnaround", "Usual time to reply, measured"),
    ("device_last_good_seconds", "last_good", "Seconds since the last good read"),
)
_ZENOH = (
    ("zenoh_published_total", "published", "Messages given to Zenoh"),
    (
        "zenoh_superseded_total",
        "superseded",
        "Values replaced by a newer one before they were sent",
    ),
    ("zenoh_dropped_total", "dropped", "Events and documents without room in the queue"),
    ("zenoh_congested_total", "congested", "Puts that found a link full"),
    ("zenoh_queries_total", "queries", "Queries that arrived"),
    ("zenoh_queries_refused_total", "refused", "Queries refused for lack of room"),
    ("zenoh_puts_refused_total", "puts_refused", "Writes by put dropped for lack of room"),
)
_HISTORY = (
    ("history_recorded_total", "recorded", "Samples that arrived"),
    ("history_stored_total", "stored", "Samples written to disk"),
    ("history_lost_total", "lost", "Samples dropped because the disk could not store them"),
    ("history_waiting", "waiting", "Samples in memory that are not on disk"),
    ("history_lag_seconds", "lag", "Age of the oldest sample that is not on disk"),
    ("history_bytes", "bytes", "Size of the file"),
)


class _Families(Collector):
    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


def exposition(documents: Documents, plant: Plant, *, ready: bool) -> bytes:
    """Returns all metrics as text. Takes long for a large plant: not on the event loop."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Families([*_metrics(documents, plant, ready=ready)]))
    ProcessCollector(registry=registry)
    return generate_latest(registry)


def _metrics(documents: Documents, plant: Plant, *, ready: bool) -> Iterator[Metric]:
    status = documents["status"]
    yield _one("build_info", "Versions", {"version": status["version"], **_BUILD}, 1)
    yield _one("ready", "1: the gateway serves its plant on Zenoh", {}, ready)
    yield _one("uptime_seconds", "Seconds since the start", {}, status["up"])
    yield _one("faults", "Sentences of what is wrong", {}, sum(1 for _ in faults(documents)))
    yield _one("warnings", "Sentences of what to look at", {}, sum(1 for _ in warnings(documents)))
    yield from _lines(documents)
    yield from _devices(documents, plant)
    yield from _writes(documents["outcomes"])
    yield _one("standby", "1: another gateway of the group is active", {}, stands_by(documents))
    for name, field, text in _ZENOH:
        yield _one(name, text, {}, documents["zenoh"].get(field, 0))
    yield from _transfers(documents)
    parts = _family("part_working", "1: the part of the gateway works", "part")
    for name, part in below("parts/", documents):
        parts.add_metric([name], not part["why"])
    yield parts
    days = _family("certificate_days", "Days until the certificate expires", "file")
    for _, certificate in below("certificates/", documents):
        if certificate["days"] is not None:
            days.add_metric([certificate["file"]], certificate["days"])
    yield days
    alarms = _family("alarms", "Alarms by state", "state")
    counts = documents.get("alarms", {})
    for state in filter(counts.__contains__, ALARM_STATES):
        alarms.add_metric([state], counts[state])
    yield alarms
    if (clock := documents.get("clock")) is not None:
        yield _one("clock_jumps_total", "Jumps of the clock of the machine", {}, clock["jumps"])
    links = _family("zenoh_links", "Connections by kind", "to")
    for kind in ("router", "peer", "client"):
        links.add_metric([kind], documents["zenoh"]["to"].count(kind))
    yield links
    if (history := documents.get("history")) is not None:
        yield _one("history_ok", "1: samples are stored, no damage", {}, history["state"] == "ok")
        for name, field, text in _HISTORY:
            yield _one(name, text, {}, history[field])


def _lines(documents: Documents) -> Iterator[Metric]:
    lines = [*below("lines/", documents)]
    up = _family("line_up", "1: the port is open", "line")
    silent = _family("line_silent", "1: none of its devices replies, which is one cause", "line")
    expected = _family(
        "line_expected_load_ratio", "Load that check predicts, with transfers; 1 is all", "line"
    )
    for name, document in lines:
        up.add_metric([name], document["open"])
        silent.add_metric([name], document.get("silent", False))
        expected.add_metric([name], document["expected"]["load"])
    yield from (up, silent, expected, *_calls(documents))
    for metric, field, text in _LINE:
        family = _family(metric, text, "line")
        for name, document in lines:
            family.add_metric([name], document[field])
        yield family


def _calls(documents: Documents) -> Iterator[Metric]:
    """Lines with a modem."""
    ends = _family("line_calls_total", "Ended calls and tries, by result", "line", "result")
    lasts = _family("line_call", "1: a call lasts", "line")
    for name, document in below("lines/", documents):
        if calls := document.get("calls"):
            lasts.add_metric([name], calls["state"] == "connected")
            for result, count in ({COMPLETE: 0} | calls["results"]).items():
                ends.add_metric([name, result], count)
    yield from (ends, lasts)


def _devices(documents: Documents, plant: Plant) -> Iterator[Metric]:
    line_of = {name: line for line, one in below("lines/", documents) for name in one["devices"]}
    devices = [([line_of.get(name, ""), name], one) for name, one in below("devices/", documents)]
    labels = ("line", "device")
    states = _family("device_state", "1: the device is in this state", *labels, "state")
    failures = _family("device_failures_total", "Failed transactions", *labels, "kind")
    refusals = _family("device_refusals_total", "Requests refused by the device", *labels, "code")
    for place, document in devices:
        for state in STATES:
            states.add_metric([*place, state], document["standing"] == state)
        for kind, count in document["failures"].items():
            failures.add_metric([*place, kind], count)
        for code, count in document["refusals"].items():
            refusals.add_metric([*place, code], count)
    yield from (states, failures, refusals)
    for metric, field, text in DEVICE:
        family = _family(metric, text, *labels)
        for place, document in devices:
            if document[field] is not None:
                family.add_metric(place, document[field])
        yield family
    yield _qualities(plant, line_of)


def _transfers(documents: Documents) -> Iterator[Metric]:
    labels = ("transfer", "from", "to")
    works = _family("transfer_works", "1: the last value was carried", *labels)
    ends = _family("transfer_writes_total", "Writes of transfers by outcome", *labels, "outcome")
    text = "Seconds since the target acknowledged a value"
    last = _family("transfer_last_carried_seconds", text, *labels)
    for number, document in transfers(documents):
        place = [number, document["from"], document["to"]]
        if (ago := document["last_carried"]) is not None:
            last.add_metric(place, ago)
        works.add_metric(place, document["state"] == "carried")
        for outcome in ("carried", "not_done", "refused", "unclear"):
            ends.add_metric([*place, outcome], document[outcome])
    yield from (works, ends, last)


def _qualities(plant: Plant, line_of: Mapping[str, str]) -> Metric:
    family = _family("device_tags", "Tags by quality", "line", "device", "quality")
    for device in plant.devices():
        qualities = [plant.sample(tag).quality for tag in device.tags]
        place = [line_of.get(device.name, ""), device.name]
        for quality in Quality:
            family.add_metric([*place, quality.value], qualities.count(quality))
    return family


def _writes(outcomes: Mapping[str, Any]) -> Iterator[Metric]:
    counted = _family("writes_total", "Writes and commands by outcome", "outcome")
    for outcome in sorted({"written", "unclear", "refused", *outcomes["counts"]}):
        counted.add_metric([outcome], outcomes["counts"].get(outcome, 0))
    yield counted
    text = "Time of writes and commands that reached a device"
    times = HistogramMetricFamily(f"{_PREFIX}write_seconds", text)
    buckets = [*outcomes["took"].items(), ("+Inf", outcomes["sent"])]
    times.add_metric([], buckets, sum_value=outcomes["seconds"])
    yield times


def _family(name: str, text: str, *labels: str) -> CounterMetricFamily | GaugeMetricFamily:
    kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
    return kind(_PREFIX + name, text, labels=labels)


def _one(name: str, text: str, labels: Mapping[str, str], value: float) -> Metric:
    family = _family(name, text, *labels)
    family.add_metric([*labels.values()], value)
    return family
