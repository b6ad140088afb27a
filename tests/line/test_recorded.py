"""A recording served as a simulated plant: a gateway on it gets the recorded values, no others."""

import asyncio
from pathlib import Path

from gateway.cli.line.replay import report, stations_of
from gateway.config import LineConfig, built, load
from gateway.parts.recording.replay import courses, of_units, stations_asked, timed
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue, entries
from gateway.plant.build import line_of
from gateway.protocols.driver import Span
from gateway.protocols.listening import Listenable
from gateway.protocols.vigor import Vigor
from gateway.simulator.port import open_simulator
from gateway.simulator.recorded import Answered, Change, RecordedStation, RecordedValues
from gateway.tags import Quality, Reason, Sample
from tests.line.test_replay import EXAMPLE, recorded
from tests.sim.virtual import on_virtual_time

LATE = Path(__file__).parents[1] / "cases" / "late_reply_and_bad_address" / "wire.log"


class Sink:
    def __init__(self) -> None:
        self.all: list[Sample] = []

    def samples(self, samples: list[Sample]) -> None:
        self.all += samples

    def online(self, device: object, online: bool) -> None: ...


async def polled(line: LineConfig, log: list[LoggedPiece], seconds: float) -> tuple[Sink, Answered]:
    """Runs a gateway's line on the recording."""
    units, answered, sink = of_units(line, log), Answered(), Sink()
    stations = stations_of(units, courses(units, log), log[0].at or 0.0, answered)
    network = any(device.driver.traits.over_network for device in line.devices)

    running = asyncio.create_task(
        line_of(
            line,
            line.devices,
            sink,  # type: ignore[arg-type]
            open_port=lambda receiver: open_simulator(
                stations, line.wire, receiver, paced=not network
            ),
        ).run()
    )
    await asyncio.sleep(seconds)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return sink, answered


@on_virtual_time
async def test_a_gateway_on_a_recording_gets_the_recorded_values_in_their_order() -> None:
    """Vigor and Computer Link on one line, Modbus RTU in two dialects, Modbus TCP."""
    config = load(EXAMPLE)
    logs = await recorded(config, 8.0)
    for line in config.lines:
        log = [one for one in logs[line.name] if (one.at or 0.0) > 1004.0]  # in the middle
        values: dict[str, list[object]] = {}
        for entry in log:
            if isinstance(entry, LoggedValue):
                values.setdefault(entry.tag, []).append(entry.value)
        sink, answered = await polled(line, list(timed(log)), 32.0)
        got: dict[str, list[object]] = {}
        for sample in sink.all:
            if sample.tag.key in values and sample.reason is not Reason.STARTING:
                assert sample.quality is Quality.GOOD, (sample.tag.key, sample.detail)
                got.setdefault(sample.tag.key, []).append(sample.value)
        assert got.keys() == values.keys()
        for tag, found in got.items():
            left = iter(values[tag])
            distinct = [value for n, value in enumerate(found) if n == 0 or found[n - 1] != value]
            assert all(value in left for value in distinct), (tag, found, values[tag])
            assert found[-1] == values[tag][-1], (tag, found[-6:], values[tag][-6:])
        assert answered.requests > 10


def vigor_line(**tags: str) -> LineConfig:
    named = {name: {"address": address, "every": "100ms"} for name, address in tags.items()}
    device = {"protocol": "vigor", "station": 0, "tags": named, "reply_timeout": "100ms"}
    return built({"lines": {"hall": {"port": "simulator", "devices": {"plc": device}}}}).lines[0]


def late_log() -> list[LoggedPiece]:
    with LATE.open(encoding="utf-8") as log:
        return list(timed(entries(log, "hall-1")))


def test_a_reply_that_may_belong_to_another_request_is_not_served() -> None:
    line, log = vigor_line(), late_log()
    before = courses(of_units(line, log[:3]), log[:3])["plc"].first
    assert before == {("D", 1): 0x1234, ("D", 2): 0xABCD}
    # The same reply comes once more: one of the two may have been late.
    assert courses(of_units(line, log), log)["plc"].first == {}


@on_virtual_time
async def test_what_the_recording_does_not_hold_is_refused_and_counted() -> None:
    log = late_log()[:3]
    sink, answered = await polled(vigor_line(known="D1", other="D7"), log, 2.0)
    known = {sample.value for sample in sink.all if sample.tag.name == "known"}
    other = [sample for sample in sink.all if sample.tag.name == "other"]
    assert known == {0x1234}
    assert {sample.value for sample in other} == {None}
    assert other[-1].reason is Reason.REFUSED
    assert "for what the recording does not hold: station 0: D" in report(answered)


@on_virtual_time
async def test_a_station_that_the_recording_does_not_hold_is_silent_and_counted() -> None:
    line, log = vigor_line(known="D1"), late_log()[:3]
    units, answered = of_units(line, log), Answered()
    stations = stations_of(units, courses(units, log), 0.0, answered)
    request = bytes.fromhex(log[0].data.hex()).replace(b"00", b"07", 1)
    request = request[:-2] + f"{sum(request[1:-2]) & 0xFF:02X}".encode()
    assert [station.hear(request, 1.0) for station in stations] == [[], []]
    assert report(answered) == "1 requests, 1 for what the recording does not hold: station 7 (1)"


def test_a_value_comes_at_its_time_and_the_last_one_stays() -> None:
    driver = Vigor(station=0)
    course = RecordedValues([Change(100.0, ("D", 1), 1), Change(101.0, ("D", 1), 2)])
    station = RecordedStation(driver, course, 90.0, Answered())
    found = []
    for now in (0.0, 5.0, 10.0, 10.9, 11.0, 99.0):
        station.hear(b"", now)
        found += station.memory.read("D", 1)
    assert found == [1, 1, 1, 1, 2, 2]


def test_the_stations_are_those_of_the_requests() -> None:
    driver = Vigor(station=0)
    assert isinstance(driver, Listenable)
    assert stations_asked(driver, late_log(), 0.001) == [0]
    assert Span("D", 1, 1) in [tag.span for tag in of_units(vigor_line(), late_log()).tags]
