"""A protocol of another package (examples/driver): its entry point is enough for every command."""

import sys
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toy_plc import Toy, ToyStation, toy_station

from gateway.cli.line import direct
from gateway.cli.line.scan import Plan, planned, scan
from gateway.cli.main import main
from gateway.config import Config, ConfigErrors, load, schema
from gateway.planning.wire_timing import WireTiming
from gateway.protocols import registry as protocols
from gateway.protocols.driver import Driver, Span
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from gateway.simulator.port import open_simulator
from gateway.stations import registry as stations
from gateway.tags import Quality, WriteResult
from gateway.transport import Port, Receiver, SerialSettings
from gateway.values import Kind
from tests.e2e.processes import ROOT, write_config
from tests.sim.virtual import on_virtual_time


def installed(folder: Path, package: str, entry: str) -> None:
    """Writes what pip leaves of a package: its name and its entry point."""
    left = folder / f"{package}-1.0.dist-info"
    left.mkdir()
    (left / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (left / "entry_points.txt").write_text(f"[gateway.protocols]\n{entry}\n")


@pytest.fixture(autouse=True)
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages on the path; the toy is one of them."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    project = tomllib.loads((ROOT / "examples/driver/pyproject.toml").read_text("utf-8"))
    [(name, place)] = project["project"]["entry-points"]["gateway.protocols"].items()
    installed(folder, project["project"]["name"], f"{name} = {place}")
    yield folder
    for protocol in ("toy", "broken"):
        protocols._PROTOCOLS.pop(protocol, None)
        protocols._FAULTS.pop(protocol, None)


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


def check(file: Path, monkeypatch: pytest.MonkeyPatch) -> object:
    """`plc-gateway check` in this process. Returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["plc-gateway", "check", str(file)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code or 0


def test_check_forecasts_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check(plant(tmp_path, "/dev/ttyS3"), monkeypatch) == 0
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
    assert "toy" in protocols.PROTOCOLS
    with pytest.raises(ValueError, match="a protocol toy already"):
        protocols.register(Toy)
    with pytest.raises(ValueError, match="a station for toy already"):
        stations.register("toy", toy_station)


SOURCES = {
    "broken_at_import": "raise RuntimeError('no licence')",
    "broken_class": (
        "from dataclasses import dataclass\n@dataclass\nclass Half:\n"
        "    protocol: str = 'broken'\n    station: int = 1\n"
        "from toy_plc import Toy as Other\nnothing = None\n"
    ),
}


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("broken_nowhere:Half", "ModuleNotFoundError: No module named 'broken_nowhere'"),
        ("broken_at_import:Half", "RuntimeError: no licence"),
        ("broken_class:Missing", "AttributeError: module 'broken_class' has no attribute"),
        ("broken_class:nothing", "TypeError: "),
        (
            "broken_class:Half",
            "its driver has no address, areas, codec, cost, read, resync, spell, timing, traits",
        ),
        ("broken_class:Other", "its driver calls itself toy"),
    ],
)
def test_a_broken_package_is_named_where_a_file_uses_it_and_nowhere_else(
    packages: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    place: str,
    why: str,
) -> None:
    for name, source in SOURCES.items():
        (packages / f"{name}.py").write_text(source)
    installed(packages, "half-plc", f"broken = {place}")
    assert check(plant(tmp_path), monkeypatch) == 0
    assert "broken" not in capsys.readouterr().err
    file = plant(tmp_path, protocol="broken")
    assert check(file, monkeypatch) == 2
    said = capsys.readouterr().err
    assert "hall.devices.toy.protocol: " in said
    assert f"the protocol broken of half-plc 1.0 cannot be used: {why}" in said
    assert "broken" not in protocols.PROTOCOLS
    for name in SOURCES:
        sys.modules.pop(name, None)


def test_two_packages_with_one_protocol_are_both_named(packages: Path, tmp_path: Path) -> None:
    installed(packages, "one-plc", "broken = toy_plc:Toy")
    installed(packages, "other-plc", "broken = toy_plc:Toy")
    with pytest.raises(ConfigErrors) as error:
        load(plant(tmp_path, protocol="broken"))
    for name in ("one-plc 1.0", "other-plc 1.0", "cannot be used: remove one of them"):
        assert name in str(error.value)


def test_no_package_takes_the_place_of_a_protocol_of_the_gateway(packages: Path) -> None:
    installed(packages, "evil-plc", "vigor = toy_plc:Toy")
    assert protocols.PROTOCOLS["vigor"].settings is Vigor
    assert list(protocols.PROTOCOLS).count("vigor") == 1


def test_the_list_of_protocols_has_those_of_other_packages_that_work(packages: Path) -> None:
    installed(packages, "half-plc", "broken = broken_nowhere:Half")
    names = list(protocols.PROTOCOLS)
    assert "toy" in names
    assert "broken" not in names
    assert len(protocols.PROTOCOLS) == len(names)
