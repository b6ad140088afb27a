"""A rollout at real programs: a table of three gateways, files that break them, a partition.

Each test begins and ends with every pump at `D1`: another worker may run any of them.
"""

import json
import shutil
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.e2e.processes import Done, Program, gateway, plc_gateway, started, station, until
from tests.zenoh_peer import free_endpoint, free_port

SECRET = 2 * "0123456789abcdef"
WRITER = {"PLC_GATEWAY_WRITER": f"ana:{SECRET}"}
QUICK = ("--wait", "1s", "--look", "1s", "--within", "5min")
TEMPLATE = """\
# The pumping station ${name}
gateway: {name: ${name}}
writers: {file: ${secrets}}
remote: {writers: [${writer}]}
zenoh: {prefix: works/${area}, mode: client, listen: [], connect: [${router}]}
defaults: {every: ${every}}
templates: {pump: {parameters: [base], tags: {speed: {address: "D{base}"}}}}
lines:
  hall:
    port: ${port}
    devices:
      pump-${name}: {use: pump, base: ${base}, protocol: vigor, station: ${station}, ${slow}}
"""


@contextmanager
def router(*listen: str, connect: str = "") -> Iterator[None]:
    setup = zenoh.Config()
    setup.insert_json5("mode", '"router"')
    setup.insert_json5("listen/endpoints", json.dumps(listen))
    setup.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    setup.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(setup):
        yield


class Plant:
    """Three gateways. Gateway b has a PLC of its own, c a router of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.files = folder, folder / "files"
        self.endpoint, self.other = free_endpoint(), free_endpoint()
        self.port = free_port()
        self.between = ExitStack()  # the router of c
        self.programs: dict[str, Program] = {}
        (folder / "station.yaml").write_text(TEMPLATE)

    def render(self, base: int, **of_b: object) -> Done:
        """Writes the files: every pump at `D<base>`, and other cells of gateway b."""
        rows = {
            name: {"name": name, "area": "north", "router": self.endpoint, "every": "200ms"}
            | {"secrets": "writers.txt", "writer": "ana"}
            | {"port": "simulator", "base": base, "station": 1, "slow": "reply_timeout: 2s"}
            for name in "abc"
        }
        rows["b"] |= {"port": f"tcp://127.0.0.1:{self.port}", **of_b}
        rows["c"] |= {"area": "south", "router": self.other}
        lines = [";".join(rows["a"]), *(";".join(map(str, one.values())) for one in rows.values())]
        (self.folder / "stations.csv").write_text("\n".join(lines))
        return self.fleet(
            "render", *(self.folder / one for one in ("station.yaml", "stations.csv"))
        )

    def fleet(self, command: str, *options: object) -> Done:
        return plc_gateway("fleet", "works", command, *options, self.files, env=WRITER)

    def apply(self, *options: object) -> tuple[Done, dict[str, dict[str, Any]]]:
        """Returns the result of each gateway by name."""
        done = self.fleet("apply", *QUICK, *options, "--connect", self.endpoint, "--json")
        found = [json.loads(line) for line in done.out.splitlines()]
        return done, {one["gateway"].rpartition("/")[2]: one for one in found}

    def own(self, name: str) -> Path:
        return self.folder / name / f"{name}.yaml"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    plant = Plant(tmp_path_factory.mktemp("plant"))
    done = plant.render(1)
    assert "3 files written" in done.out, done.err
    with ExitStack() as stack:
        stack.enter_context(router(plant.endpoint))
        stack.enter_context(station("tcp", str(plant.port)))
        for name in "abc":
            plant.own(name).parent.mkdir()
            shutil.copy(plant.files / f"{name}.yaml", plant.own(name))
            for secret in ("writers.txt", "others.txt"):
                file = plant.own(name).with_name(secret)
                file.write_text(f"ana:{SECRET}\n")
                file.chmod(0o600)
        with plant.between:
            plant.between.enter_context(router(plant.other, connect=plant.endpoint))
            for name in "abc":
                plant.programs[name] = stack.enter_context(started(plant.own(name)))
                plant.programs[name].says("device online")
            plant.render(2)  # a gateway asked for its own file checks no signature
            until(lambda: plant.apply("--check")[0].code == 0, "all gateways take files")
            plant.render(1)
            yield plant


def writer() -> list[str]:
    return [f"{name}={value}" for name, value in WRITER.items()]


def results(found: dict[str, dict[str, Any]]) -> list[str]:
    return [found[name]["result"] for name in "abc"]


def test_all_gateways_get_their_files_and_the_next_run_finds_them_there(plant: Plant) -> None:
    assert "3 files written, 0 were so already" in plant.render(2).out
    assert "0 files written, 3 were so already" in plant.render(2).out
    shown = plc_gateway("fleet", "works", "--connect", plant.endpoint, "--folder", plant.files)
    assert shown.out.count("its file differs from") == 3
    done, found = plant.apply("--check")
    assert (done.code, results(found)) == (0, ["good", "good", "good"])
    done, found = plant.apply()
    assert (done.code, results(found)) == (0, 3 * ["confirmed"]), done.err
    assert plant.own("a").read_text() == (plant.files / "a.yaml").read_text()
    # A sheet travels in the file.
    (plant.files / "a.csv").write_text("name,address\nlevel,D9\n")
    file = plant.files / "a.yaml"
    file.write_text(
        file.read_text().replace("protocol: vigor", "protocol: vigor, tags_from: a.csv")
    )
    done, found = plant.apply()
    assert (done.code, results(found)) == (0, ["confirmed", "same", "same"]), done.err
    assert "level: {address: D9}" in plant.own("a").read_text()
    done, found = plant.apply()
    assert (done.code, results(found)) == (0, 3 * ["same"])
    plant.render(1)
    assert plant.apply()[0].code == 0


def test_a_file_that_breaks_a_device_goes_back_and_stops_the_rollout(plant: Plant) -> None:
    plant.render(2, station=2)  # the PLC has station 1
    done, found = plant.apply("--parallel", 1)
    assert (done.code, results(found)) == (1, ["confirmed", "worse", "left"])
    assert "pump-b is silent, and was up" in found["b"]["says"]
    assert "it went back" in found["b"]["says"]
    assert found["c"]["says"] == "works/north/b: worse"
    assert "base: 1," in plant.own("b").read_text()
    assert "works/north/a: confirmed" in done.err
    assert "--back" in done.err
    done, found = plant.apply("--back")
    assert (done.code, results(found)) == (0, ["confirmed", "same", "same"])
    for name in "abc":
        assert "base: 1," in plant.own(name).read_text()


def test_a_file_that_overloads_a_line_cuts_the_network_or_locks_writers_out_is_refused(
    plant: Plant,
) -> None:
    for of_b, says in (
        ({"every": "1ms"}, "line hall is asked for"),
        ({"router": "tcp/127.0.0.1:1"}, "zenoh.connect changed"),
        ({"writer": "bob"}, "remote.writers changed"),
        ({"secrets": "others.txt"}, "writers.file changed"),
    ):
        plant.render(1, **of_b)
        done, found = plant.apply()
        assert (done.code, results(found)) == (1, ["same", "refused", "same"])
        assert says in found["b"]["says"]
    assert plant.apply("--check")[1]["b"]["result"] == "refused"
    assert "base: 1," in plant.own("b").read_text()


def test_a_second_rollout_is_refused_while_a_file_waits(plant: Plant) -> None:
    plant.render(3)
    rollout = [*("fleet", "works", "apply", plant.files, "--connect", plant.endpoint), *QUICK[2:]]
    with gateway(*rollout, "--wait", "10min", variables=writer()) as first:
        waits = "waits for confirmation"
        until(lambda: waits in plc_gateway("status", plant.own("a")).out, "a canary waits")
        done, found = plant.apply()
        assert (done.code, found) == (1, {})
        assert "works/north/a: the file of ana waits until" in done.err
        assert first.end(signal.SIGINT) == 1
        assert first.has_said("works/north/a: back: it went back: it was ended by Ctrl-C")
        assert first.has_said("works/south/c: left")
    assert "base: 1," in plant.own("a").read_text()


def test_a_partition_in_the_middle_of_a_rollout(plant: Plant) -> None:
    """The gateway puts its file back by itself. The next run goes on with it."""
    plant.render(4)
    alone = plant.folder / "alone"
    alone.mkdir()
    shutil.copy(plant.files / "c.yaml", alone)
    pace = ("--canary", 0, "--look", "20s", "--within", "10s")
    c = plant.programs["c"]
    lines = len(c.lines)
    rollout = ("fleet", "works", "apply", alone, "--connect", plant.endpoint, *pace)
    with gateway(*rollout, variables=writer()) as first:
        c.says("file taken over", after=lines)
        plant.between.close()
        assert first.ended() == 1
        assert first.has_said("works/south/c: lost: ")
    c.says("file went back", after=lines)
    assert "base: 1," in plant.own("c").read_text()
    done, found = plant.apply()
    assert (done.code, results(found)) == (1, ["confirmed", "confirmed", "unreachable"])
    assert "2 have the new file" in done.err
    plant.between.enter_context(router(plant.other, connect=plant.endpoint))
    until(lambda: plant.apply()[0].code == 0, "c has its file")
    assert "base: 4," in plant.own("c").read_text()
    plant.render(1)
    assert plant.apply()[0].code == 0
