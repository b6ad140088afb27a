"""The metrics: every fault of the documents is in them."""

from prometheus_client.parser import text_string_to_metric_families

from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.northbound.requests.audit import Counts
from gateway.parts.web import metrics
from gateway.tags import WriteResult
from tests.northbound.plant import mixer
from tests.web.serving import PlainNorth, calling, transfer


def outcome(took: float, problem: Problem | None = None) -> WriteOutcome:
    result = WriteResult(1, 0, took) if problem is None else Failure(problem, "no")
    return WriteOutcome("k", 1, result, 0, took)


async def scraped(north: PlainNorth) -> dict[tuple[str, ...], float]:
    """The samples: by name and values of the labels, sorted by the names of the labels."""
    text = metrics.exposition(await north.documents(0.0), mixer(), ready=True)
    return {
        (sample.name, *(sample.labels[label] for label in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
    }


async def test_writes_are_counted_by_outcome_and_time() -> None:
    counts = Counts()
    counts.count(outcome(0.03), was_sent=True)
    counts.count(outcome(0.3, Problem.UNCLEAR), was_sent=True)
    counts.count(outcome(20.0), was_sent=True)
    counts.count(outcome(0.0, Problem.BUSY), was_sent=False)
    north = PlainNorth()
    north.changed["outcomes"] = counts.document()
    found = await scraped(north)
    writes = "plc_gateway_writes_total"
    assert (found[writes, "written"], found[writes, "unclear"], found[writes, "busy"]) == (2, 1, 1)
    assert found[writes, "refused"] == 0  # a counter begins at 0: otherwise its first is not seen
    bucket = "plc_gateway_write_seconds_bucket"
    assert [found[bucket, end] for end in ("0.025", "0.05", "0.5", "5", "+Inf")] == [0, 1, 2, 2, 3]
    assert found["plc_gateway_write_seconds_count",] == 3


async def test_history_that_is_not_written_is_not_ok() -> None:
    fields = ("recorded", "stored", "lost", "waiting", "lag", "bytes")
    north = PlainNorth()
    north.changed["history"] = {"state": "no space left on device", **dict.fromkeys(fields, 3)}
    found = await scraped(north)
    assert found["plc_gateway_history_ok",] == 0
    assert found["plc_gateway_faults",] == 2  # that, and the silent oven
    assert found["plc_gateway_history_lost_total",] == 3


async def test_values_are_counted_by_quality() -> None:
    found = await scraped(PlainNorth())
    assert found["plc_gateway_device_tags", "mixer", "hall", "bad"] == 3
    assert found["plc_gateway_device_tags", "mixer", "hall", "good"] == 0
    assert found["plc_gateway_device_state", "oven", "hall", "silent"] == 1
    assert found["plc_gateway_device_failures_total", "mixer", "silence", "hall"] == 2


async def test_transfers_are_counted_by_outcome() -> None:
    ends = {"carried": 7, "not_done": 1, "refused": 0, "unclear": 2}
    rows = {"from": "a/x", "to": "b:D0..D9", "last_carried": 3.5, **ends}
    north = PlainNorth()
    north.changed["transfers/2"] = transfer("unclear", **rows)
    north.changed["transfers/10"] = transfer("starting")
    found = await scraped(north)
    place = ("a/x", "b:D0..D9")
    assert found["plc_gateway_transfer_works", *place, "2"] == 0
    writes = "plc_gateway_transfer_writes_total"
    assert found[writes, "a/x", "unclear", "b:D0..D9", "2"] == 2
    assert found[writes, "a/x", "carried", "b:D0..D9", "2"] == 7
    last = "plc_gateway_transfer_last_carried_seconds"
    assert [value for (name, *_), value in found.items() if name == last] == [3.5]
    assert "plc_gateway_transfer_works" not in {name for name, *_ in await scraped(PlainNorth())}


async def test_calls_are_counted_by_result() -> None:
    north = PlainNorth()
    north.changed["lines/far"] = calling(state="connected", results={"BUSY": 2})
    found = await scraped(north)
    assert found["plc_gateway_line_call", "far"] == 1
    ends = "plc_gateway_line_calls_total"
    assert (found[ends, "far", "BUSY"], found[ends, "far", "complete"]) == (2, 0)
    assert (ends, "hall", "complete") not in found  # it has no modem
