"""Which stations answer at a port: sought on wires that are understood at one speed only."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

import pytest

from gateway.cli.line import scan as scanning
from gateway.cli.line import scan_command as show
from gateway.cli.line.scan import Plan, Report, planned, scan
from gateway.errors import ConfigError, LineDown
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.modbus import ModbusStation
from gateway.stations.station import Station
from gateway.stations.vigor import VigorStation
from gateway.transport import Port, Receiver, SerialSettings
from tests.conftest import Command
from tests.protocols.test_swapped import over_swapped_wires
from tests.sim.virtual import on_virtual_time

RIGHT = SerialSettings(19200, "7E1")
TURNAROUND = 0.02


class OldLine:
    """Stations that understand one speed and format; at any other they answer nonsense or nothing.

    It is the `Port`, too. `heard` is all that was sent, with how the port was opened.
    """

    def __init__(
        self, *stations: Station, nonsense: bytes = b"", right: SerialSettings = RIGHT
    ) -> None:
        self.stations = stations
        self.heard: list[tuple[SerialSettings | None, bytes]] = []
        self.closed = 0
        self._nonsense = nonsense
        self._right = right

    async def open(self, settings: SerialSettings | None, ear: Receiver) -> Port:
        self._settings, self._ear = settings, ear
        return self

    def write(self, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        self.heard.append((self._settings, data))
        answers: Sequence[bytes] = [self._nonsense] if self._nonsense else []
        if self._settings in (self._right, None):
            answers = [
                each for station in self.stations for each in station.hear(data, loop.time())
            ]
        for answer in answers:
            loop.call_later(TURNAROUND, self._ear.received, answer)

    async def close(self) -> None:
        self.closed += 1


def sought(
    line: OldLine, protocol: str, stations: str | None = None, port: str = "/dev/ttyS9"
) -> Plan:
    return replace(planned(port, protocol, stations), open_port=line.open)


def stations(report: Report) -> list[int]:
    return [found.driver.station for found in report.found]


@on_virtual_time
async def test_the_speed_and_format_at_which_they_answer_is_found() -> None:
    line, told = OldLine(VigorStation(2), VigorStation(17)), list[str]()
    report = await scan(sought(line, "vigor"), told.append)
    assert stations(report) == [2, 17]
    assert {found.serial for found in report.found} == {RIGHT}
    assert told == ["asking 32 stations at 9600 7E1", "asking 32 stations at 19200 7E1"]
    assert line.closed == 2
    assert not report.noises
    assert show.found_stations(report, "/dev/ttyS9").splitlines() == [
        "lines:",
        "  found:",
        "    port: /dev/ttyS9",
        "    baudrate: 19200",
        "    format: 7E1",
        "    devices:",
        "      station-2: {protocol: vigor, station: 2, tags: {}}",
        "      station-17: {protocol: vigor, station: 17, tags: {}}",
    ]


@on_virtual_time
async def test_a_vigor_in_another_format_than_its_manual_is_listed_with_it() -> None:
    other = SerialSettings(9600, "8N1")
    report = await scan(sought(OldLine(VigorStation(3), right=other), "vigor", "3"))
    [found] = report.found
    assert (found.serial, found.settings) == (other, {"format": "8N1"})


@pytest.mark.parametrize(
    ("protocol", "first"),
    [("vigor", 0), ("computer-link", 0), ("modbus-rtu", 1), ("modbus-ascii", 1)],
)
def test_station_0_is_asked_where_it_is_one_plc(protocol: str, first: int) -> None:
    assert planned("COM3", protocol).stations == list(range(first, 32))


@on_virtual_time
async def test_a_vigor_at_cp1_is_found() -> None:
    report = await scan(sought(OldLine(VigorStation(0)), "vigor"))
    assert stations(report) == [0]


@on_virtual_time
async def test_a_station_given_twice_is_asked_and_listed_once() -> None:
    report = await scan(sought(OldLine(VigorStation(1)), "vigor", "1-3,1"))
    assert show.found_stations(report, "COM3").count("station-1:") == 1


@on_virtual_time
async def test_a_line_without_stations() -> None:
    line = OldLine(VigorStation(40))
    report = await scan(sought(line, "vigor", "1-3"))
    assert not report.found
    assert {settings for settings, _ in line.heard} == set(planned("COM3", "vigor").serial)


@on_virtual_time
async def test_damaged_bytes_are_no_station_but_are_reported() -> None:
    line = OldLine(VigorStation(1), nonsense=b"\x02\xff\x7f\x15" * 4)
    report = await scan(sought(line, "vigor", "1-2"))
    assert stations(report) == [1]
    [sentence] = show.noises(report)
    assert sentence.startswith("at 9600 7E1 bytes arrived that are no reply: ")


@on_virtual_time
async def test_swapped_wires_are_named() -> None:
    heard = over_swapped_wires(b"\x0601510034F2\x03C1", 7, "E")
    report = await scan(sought(OldLine(nonsense=heard), "vigor", "1"))
    assert "A and B are swapped" in next(iter(show.noises(report)))


@pytest.mark.parametrize("frame_format", [1, 4])
@pytest.mark.parametrize("sum_check", [True, False])
@on_virtual_time
async def test_how_a_computer_link_station_wants_it(frame_format: int, sum_check: bool) -> None:
    line = OldLine(ComputerLinkStation(5, "liyan", frame_format, sum_check))  # type: ignore[arg-type]
    report = await scan(sought(line, "computer-link", "4-6"))
    [found] = report.found
    assert found.settings == {"frame_format": frame_format, "sum_check": sum_check}
    assert not found.refusal


@on_virtual_time
async def test_a_station_that_refuses_every_request_is_found() -> None:
    line = OldLine(NaySayer(ComputerLinkStation(5, "liyan", 4, True)))
    [found] = (await scan(sought(line, "computer-link", "5"))).found
    assert "10" in found.refusal
    text = show.found_stations(Report([found]), "COM3")
    assert text.endswith(f"tags: {{}}}}  # error reply: {found.refusal}")


class NaySayer:
    """Answers every whole request of format 4 with an error code."""

    def __init__(self, inner: Station) -> None:
        self._inner = inner
        self.memory = inner.memory

    def hear(self, data: bytes, now: float) -> list[bytes]:
        return [b"\x1505FF10\r\n" for _ in self._inner.hear(data, now)]


class Unplugged(OldLine):
    def write(self, data: bytes) -> None:
        self._ear.lost(LineDown("/dev/ttyS9: unplugged"))


@pytest.mark.parametrize(
    ("protocol", "minutes"),
    [("vigor", 1.5), ("modbus-rtu", 3), ("modbus-ascii", 3), ("computer-link", 11.5)],
)
@on_virtual_time
async def test_the_duration_of_a_scan_without_stations(protocol: str, minutes: float) -> None:
    """As docs/operations.md says."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    await scan(sought(OldLine(), protocol))
    assert loop.time() - began == pytest.approx(60 * minutes, rel=0.15)


@pytest.mark.parametrize("framing", ["rtu", "ascii", "tcp"])
@on_virtual_time
async def test_modbus(framing: str) -> None:
    slave = ModbusStation(station=9, framing=framing)  # type: ignore[arg-type]
    line = OldLine(slave)
    plan = sought(line, f"modbus-{framing}", "8-10", port="tcp://10.0.0.7:502")
    assert plan.serial == [None]
    report = await scan(plan)
    assert stations(report) == [9]
    assert "baudrate" not in show.found_stations(report, "tcp://10.0.0.7:502")


@on_virtual_time
async def test_a_lost_port_ends_the_scan() -> None:
    line = Unplugged()
    with pytest.raises(LineDown, match="unplugged"):
        await scan(sought(line, "vigor"))
    assert line.closed == 1


def test_the_command_prints_what_replied_before_the_port_was_lost(
    monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    class Later(Unplugged):
        def write(self, data: bytes) -> None:
            lost = len(self.heard) > 2
            (Unplugged if lost else OldLine).write(self, data)

    line = Later(VigorStation(1))

    async def opened(_port: object, settings: SerialSettings, ear: Receiver) -> Port:
        return await line.open(settings, ear)

    monkeypatch.setattr(scanning, "open_port", opened)
    monkeypatch.setattr(show, "set_up", lambda *_: None)  # needs a real stderr
    asked = ("scan", "--port", "/dev/ttyS9", "--protocol", "vigor", "--baud", "19200")
    done = command(*asked)
    assert done.code == 1
    assert "station-1: {protocol: vigor, station: 1, tags: {}}" in done.out
    assert done.err.endswith("/dev/ttyS9: unplugged\n")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"protocol": "frames"}, "scan cannot look for frames: use one of vigor, "),
        ({"protocol": "profibus"}, "scan cannot look for profibus"),
        ({"port": "simulator"}, "need no scan"),
        ({"port": "http://a:1"}, "is not a port"),
        ({"protocol": "modbus-tcp"}, "tcp://host:port"),
        ({"stations": "1-x"}, "'x' is no number"),
        ({"stations": ""}, "'' is no number"),
        ({"stations": "5-4"}, "no station between 5 and 4"),
        ({"stations": "300"}, "station 300 is not 0..255"),
        ({"bauds": "9601"}, "the nearest is 9600"),
        ({"bauds": "abc"}, "'abc' is no number: write numbers such as 9600,19200"),
        ({"formats": "9Z9"}, "no character format"),
        ({"timeout": "5"}, "no unit|no duration"),
    ],
)
def test_a_wrong_option_is_reported(given: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        planned(**{"port": "/dev/ttyS9", "protocol": "vigor", **given})


def test_given_settings_are_tried_in_their_order() -> None:
    plan = planned("COM3", "vigor", "3,7-9", "19200,4800", "8N1,7E1", "1s")
    assert plan.stations == [3, 7, 8, 9]
    assert plan.timeout == 1
    assert [f"{one.baudrate} {one.format}" for one in plan.serial if one is not None] == [
        *("19200 8N1", "4800 8N1", "19200 7E1", "4800 7E1")
    ]
