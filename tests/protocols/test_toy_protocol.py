"""A protocol that the package does not know: registered from outside, it works everywhere.

The toy device holds numbers N0 to N99. `R5 N7` reads one at station 5, `W5 N7 42` writes one;
the reply is `=5 N7 42`, or `!5 N7` where the number does not exist.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest

from gateway.cli.line import direct
from gateway.cli.line.scan import Plan, planned, scan
from gateway.cli.main import main
from gateway.config import Config, ConfigErrors, load, schema
from gateway.errors import ConfigError, Refusal, Refused
from gateway.planning.wire_timing import WireTiming
from gateway.protocols import registry as protocols
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.driver import Address, Area, Cost, Driver, Span, Talk, Timing, Traits, Unit
from gateway.simulator.plant import station_for
from gateway.simulator.port import open_simulator
from gateway.stations import registry as stations
from gateway.stations.station import Memory
from gateway.tags import Quality, WriteResult
from gateway.transport import Port, Receiver, SerialSettings
from gateway.values import Kind
from tests.e2e.processes import write_config
from tests.sim.virtual import on_virtual_time

NUMBERS = Area("N", Unit.WORD, 0, 99)


class ToyCodec:
    """One frame is one line of text."""

    def __init__(self) -> None:
        self._buffer = b""

    def encode(self, frame: str) -> bytes:
        return frame.encode() + b"\n"

    def feed(self, data: bytes) -> list[str]:
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [line.decode("ascii", "replace") for line in lines]


@dataclass(frozen=True, slots=True, kw_only=True)
class Toy:
    """The driver; its fields are its settings in the file."""

    protocol: Literal["toy"] = "toy"
    station: int = 1
    upper: bool = True  # the letters of requests

    scan_hints: ClassVar = ScanHints(
        formats=("8E2",), stations=range(3, 10), variants=({"upper": False}, {"upper": True})
    )

    def __post_init__(self) -> None:
        if not 1 <= self.station <= 9:
            raise ConfigError(f"station {self.station} is not 1..9")

    @property
    def traits(self) -> Traits:
        return Traits(baudrate=4800, format="8E2", binary=True, word_type=Kind.UINT16)

    @property
    def timing(self) -> Timing:
        return Timing(reply_timeout=0.2)

    @property
    def areas(self) -> Mapping[str, Area]:
        return {"N": NUMBERS}

    def address(self, text: str) -> Address:
        if text[:1] != "N" or not text[1:].isdecimal() or int(text[1:]) > NUMBERS.last:
            raise ConfigError(f"{text} is no address: write N0 to N{NUMBERS.last}")
        return Address("N", int(text[1:]))

    def spell(self, address: Address) -> str:
        return f"N{address.number}"

    def cost(self, span: Span) -> Cost | None:
        return Cost(7, 13) if span.size == 1 else None

    def write_cost(self, span: Span) -> Cost | None:
        return Cost(13, 13) if span.size == 1 else None

    def codec(self) -> ToyCodec:
        return ToyCodec()

    async def read(self, talk: Talk[str], span: Span) -> Sequence[int]:
        return [await self._ask(talk, "R", f"N{span.start}")]

    async def write(self, talk: Talk[str], span: Span, units: Sequence[int]) -> bool:
        await self._ask(talk, "W", f"N{span.start} {units[0]}")
        return True

    async def resync(
        self,
        talk: Talk[str],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        number = probe_token % 100
        if outstanding is not None and number == outstanding.start:
            number = (number + 1) % 100
        await self._ask(talk, "R", f"N{number}")
        return 99

    async def _ask(self, talk: Talk[str], letter: str, body: str) -> int:
        name = body.split()[0]
        expected = f"{self.station} {name}"

        def accept(frame: str) -> int | None:
            if frame == f"!{expected}":
                raise Refused(f"{name} does not exist", code="!", refusal=Refusal.ADDRESS)
            begin = f"={expected} "
            return int(frame.removeprefix(begin)) if frame.startswith(begin) else None

        command = letter if self.upper else letter.lower()
        return await talk.ask(f"{command}{self.station} {body}", 13, accept)


class ToyStation:
    """The simulated device."""

    def __init__(self, station: int, upper: bool) -> None:
        self.memory = Memory([("N", NUMBERS.first, NUMBERS.last)])
        self._station = station
        self._letters = "RW" if upper else "rw"
        self._codec = ToyCodec()

    def hear(self, data: bytes, now: float) -> list[bytes]:
        replies = [self._reply(frame, now) for frame in self._codec.feed(data)]
        return [self._codec.encode(reply) for reply in replies if reply]

    def _reply(self, frame: str, now: float) -> str:
        command, name, *value = frame.split()
        if command[0] not in self._letters or command[1:] != str(self._station):
            return ""
        number = int(name[1:])
        if not self.memory.holds("N", number):
            return f"!{self._station} {name}"
        if value:
            self.memory.write("N", number, [int(value[0])])
        [held] = self.memory.read("N", number, 1, now)
        return f"={self._station} {name} {held}"


def toy_station(driver: Toy) -> ToyStation:
    return ToyStation(driver.station, driver.upper)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    protocols.register(Toy)
    stations.register("toy", toy_station)
    yield
    protocols.unregister("toy")
    stations.unregister("toy")


def plant(folder: Path, port: str = "simulator", **settings: Any) -> Path:
    tags = {
        "level": {"address": "N7"},
        "limit": {"address": "N8", "write": {"min": 1, "max": 50, "verify": True}},
    }
    toy = {"protocol": "toy", "station": 4, "tags": tags, **settings}
    lines = {"hall": {"port": port, "devices": {"toy": toy}}}
    return write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines)


def config(folder: Path) -> Config:
    return load(plant(folder))


def test_the_toy_is_a_driver() -> None:
    """Mypy reads this as well."""
    driver: Driver[str] = Toy()
    assert driver.traits.numbered


def test_its_settings_are_read_from_the_file_and_the_rest_are_its_defaults(tmp_path: Path) -> None:
    [line] = load(plant(tmp_path, "/dev/ttyS3", upper=False)).lines
    [device] = line.devices
    assert device.driver == Toy(station=4, upper=False)
    assert (line.serial.baudrate, line.serial.format) == (4800, "8E2")
    assert device.timing.reply_timeout == 0.2
    assert {tag.layout.type.kind for tag in device.tags} == {Kind.UINT16}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"station": 12}, "toy.station: station 12 is not 1..9"),
        ({"uper": True}, "toy.uper: no setting of a toy device: did you mean upper?"),
        ({"upper": "loud"}, "toy.upper: 'loud' is neither true nor false"),
        (
            {"tags": {"a": {"address": "Z1"}}},
            "toy.tags.a.address: Z1 is no address",
        ),
    ],
)
def test_its_mistakes_are_reported_with_their_place(
    tmp_path: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigErrors) as error:
        load(plant(tmp_path, **settings))
    assert message in str(error.value)


def test_the_schema_has_its_settings() -> None:
    properties = schema()["$defs"]["toy"]["properties"]
    assert properties["upper"]["type"] == "boolean"
    assert (properties["station"]["minimum"], properties["station"]["maximum"]) == (1, 9)


def test_check_forecasts_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["plc-gateway", "check", str(plant(tmp_path, "/dev/ttyS3"))])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    assert "4800" in capsys.readouterr().out


async def test_it_is_polled_and_written_on_a_simulated_line(tmp_path: Path) -> None:
    loaded = config(tmp_path)
    tags = {tag.name: tag for device in loaded.devices for tag in device.tags}
    samples = await direct.read(loaded, list(tags.values()))
    assert {sample.quality for sample in samples} == {Quality.GOOD}
    [result] = await direct.write_group(loaded, [(tags["limit"], 42)])
    assert isinstance(result, WriteResult)
    assert (result.value, result.verified) == (42, True)


async def test_a_refused_address_is_reported(tmp_path: Path) -> None:
    loaded = config(tmp_path)
    [device] = loaded.devices
    beyond = replace(device.tags[0], span=Span("N", 100, 1))
    line = replace(loaded.lines[0], devices=(replace(device, tags=(beyond,)),))
    [sample] = await direct.read(replace(loaded, lines=(line,)), [beyond])
    assert (sample.quality, sample.detail) == (Quality.BAD, "N100 does not exist")


def test_its_values_move_in_the_simulator(tmp_path: Path) -> None:
    [device] = config(tmp_path).devices
    memory = station_for(device.driver, device.tags).memory
    level = {memory.read("N", 7, 1, float(second))[0] for second in range(60)}
    assert len(level) > 10


@on_virtual_time
async def test_scan_finds_it_with_its_settings() -> None:
    wire = WireTiming(4800, 12)

    async def opened(settings: SerialSettings | None, receiver: Receiver) -> Port:
        there = [ToyStation(3, upper=True), ToyStation(6, upper=False)]
        return await open_simulator(there, wire, receiver)

    plan: Plan = planned("/dev/ttyS9", "toy", bauds="4800")
    assert plan.serial == [SerialSettings(4800, "8E2")]
    report = await scan(replace(plan, open_port=opened))
    assert {found.driver.station: found.settings for found in report.found} == {
        3: {"upper": True},
        6: {"upper": False},
    }


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ValueError, match="a protocol toy already"):
        protocols.register(Toy)
    with pytest.raises(ValueError, match="a station for toy already"):
        stations.register("toy", toy_station)
