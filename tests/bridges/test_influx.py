"""`bridge influx` with InfluxDB, and with a server that fails."""

import json
import shlex
import signal
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from gateway.bridges.influx.gaps import Gaps
from gateway.bridges.influx.lines import line_of
from gateway.errors import ConfigError
from tests.bridges.conftest import bridge
from tests.bridges.played import PlayedGateway, document
from tests.e2e.processes import (
    ROOT,
    Program,
    free_port,
    listens,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64"},
    "mixer/total": {"type": "int64"},
    "mixer/name": {"type": "string[8]"},
    "mixer/steps": {"type": "float32[2]", "length": 2},
}

MISSED = 35 * 10**8  # ns: simulated values change once or twice in 1.5 s


class Influx:
    """A server of InfluxDB with a database `plant`."""

    def __init__(self, influxd: str, folder: Path) -> None:
        self.url = f"http://127.0.0.1:{free_port()}"
        self._command = (influxd, "-config", folder / "influx.conf")
        where = urllib.parse.urlsplit(self.url).netloc
        (folder / "influx.conf").write_text(
            f'reporting-disabled = true\nbind-address = "127.0.0.1:{free_port()}"\n'
            f'[meta]\ndir = "{folder}/meta"\n'
            f'[data]\ndir = "{folder}/data"\nwal-dir = "{folder}/wal"\n'
            f'[http]\nbind-address = "{where}"\nlog-enabled = false\n'
            "[monitor]\nstore-enabled = false\n"
        )

    def run(self) -> Program:
        program = Program(*self._command)
        program.says("Listening for signals")
        return program

    def query(self, text: str) -> list[list[Any]]:
        """Returns the rows of an answer, each with its time in microseconds since 1970."""
        about = urllib.parse.urlencode({"q": text, "db": "plant", "epoch": "u"}).encode()
        with urllib.request.urlopen(f"{self.url}/query", about, timeout=300) as answer:  # noqa: S310
            [result] = json.load(answer)["results"]
        rows: list[list[Any]] = result.get("series", [{"values": []}])[0]["values"]
        return rows

    def speeds(self) -> list[object]:
        """Returns the values, None while it was bad."""
        rows = self.query("SELECT value, good FROM plc WHERE \"name\"='speed'")
        return [value for value, _ in groupby(row[1] for row in rows)]


def router(endpoint: str) -> Program:
    setup = {"mode": "router", "listen": [endpoint], "connect": [], "config": {}}
    program = Program(sys.executable, ROOT / "tests" / "zenoh_peer.py", json.dumps(setup))
    until(lambda: listens(int(endpoint.rpartition(":")[2])), "the router listens")
    return program


def test_influxdb_has_every_value_once_and_no_good_one_that_is_not(
    influxd: str, tmp_path: Path
) -> None:
    endpoint, influx = free_endpoint(), Influx(influxd, tmp_path)
    to = f"{influx.url}/write?db=plant"
    with router(endpoint) as first, influx.run() as server:
        influx.query("CREATE DATABASE plant")
        with (
            PlayedGateway(endpoint, TAGS, "connect") as gateway,
            bridge("influx", "--connect", endpoint, "--to", to, "--every", 0.1) as program,
        ):
            program.says("gateway demo is there")
            gateway.put("mixer/speed", 12.5)
            gateway.put("mixer/total", 2**53 + 1)
            gateway.put("mixer/name", 'A "B"\\')
            until(lambda: bool(influx.query("SELECT text FROM plc WHERE \"name\"='name'")), "it is")
            [[time, value, is_good]] = influx.query(
                "SELECT value, good FROM plc WHERE device='mixer' AND \"name\"='speed'"
            )
            sent = gateway.documents["mixer/speed"]["time"]
            since = datetime.fromisoformat(sent) - datetime.fromtimestamp(0, UTC)
            assert time == since // timedelta(microseconds=1)
            assert (value, is_good) == (12.5, True)
            [[_, text]] = influx.query("SELECT text FROM plc WHERE \"name\"='name'")
            assert text == 'A "B"\\'
            [[_, text]] = influx.query("SELECT text FROM plc WHERE \"name\"='total'")
            assert text == str(2**53 + 1)
            gateway.put("mixer/steps", [1, 2.5])
            steps = "SELECT value_0, value_1 FROM plc WHERE \"name\"='steps'"
            until(lambda: [row[1:] for row in influx.query(steps)] == [[1.0, 2.5]], "the array")

            first.end(signal.SIGKILL)
            until(lambda: influx.speeds() == [12.5, None], "the value is bad")
            with router(endpoint):
                until(lambda: influx.speeds() == [12.5, None, 12.5], "the value is good again")
                server.end(signal.SIGKILL)
                after = len(program.lines)
                gateway.put("mixer/speed", 13.5)
                program.says("not sent", after=after)
                gateway.put("mixer/speed", 14.5)
                with influx.run():
                    expected = [12.5, None, 12.5, 13.5, 14.5]
                    until(lambda: influx.speeds() == expected, "the values arrive late")
                    assert program.end() == 0


@contextmanager
def failing_server(codes: list[int], bodies: list[str]) -> Iterator[str]:
    """Answers with these codes, the last one again and again; yields its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            bodies.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(codes.pop(0) if len(codes) > 1 else codes[0])
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/api/v2/write?bucket=plant"
        finally:
            server.shutdown()
            thread.join()


def test_lost_and_refused_lines_are_counted_and_reported(tmp_path: Path) -> None:
    endpoint, bodies = free_endpoint(), list[str]()
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        failing_server([400, 503, 204], bodies) as to,
    ):
        gateway.put("mixer/speed", 0)
        options = ("--connect", endpoint, "--to", to, "--every", 0.1, "--queue", 3)
        with bridge("influx", *options) as program:
            program.says("1 lines refused")
            for value in range(1, 6):
                gateway.put("mixer/speed", value)
            program.says("3 lines wait, 2 are lost")
            until(lambda: len(bodies) == 3, "the lines are sent again")
            *lines, note = bodies[-1].splitlines()
            assert [line.split(" ")[1] for line in lines] == [
                f"value={value}.0,good=true" for value in (3, 4, 5)
            ]
            assert note.startswith("plc_bridge lost=2i,refused=1i,recovered=0i ")


def test_what_a_killed_bridge_has_missed_comes_from_the_history(tmp_path: Path) -> None:
    endpoint, bodies, state = free_endpoint(), list[str](), tmp_path / "state.json"
    tags = {"speed": {"address": "D100", "every": "50ms", "history": True}}
    lines = {"hall": vigor_line("simulator", tags)}
    file = write_config(tmp_path / "c.yaml", endpoint, lines, history={"path": "history.db"})

    def times() -> list[int]:
        text = "".join(bodies).splitlines()
        return sorted({int(line.split()[-1]) for line in text if "name=speed" in line})

    with started(file), failing_server([204], bodies) as to:
        options = ("--connect", endpoint, "--to", to, "--every", 0.1, "--state", state)
        with bridge("influx", *options) as first:
            until(state.exists, "the state is kept")
            first.end(signal.SIGKILL)
        before = times()[-1]
        until(lambda: time.time_ns() > before + MISSED, "samples are missed")
        with bridge("influx", *options) as second:
            second.says("samples of mixer since", "recovered")
            missed = range(before + 1, before + MISSED)
            until(lambda: sum(at in missed for at in times()) > 1, "the missed samples arrive")
            assert second.end() == 0


async def test_a_gap_is_kept_until_it_is_filled(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    gaps = Gaps(path)
    gaps.heard("a", answers=True)
    assert gaps.take("a") is None  # nothing was sent before
    gaps.sent("a", "T5")
    gaps.sent("a", "T3")
    await gaps.save()
    again = Gaps(path)
    again.heard("a", answers=True)
    again.sent("a", "T6")
    again.heard("a", answers=True)
    again.open("a", "T7")
    assert (again.take("b"), again.take("a")) == (None, "T5")
    again.sent("a", "T9")
    await again.save()
    assert json.loads(path.read_text()) == {"a": "T5"}  # the server does not have them yet
    again.filled("a")
    again.heard("a", answers=False)
    assert again.take("a") is None
    again.heard("a", answers=True)
    assert again.take("a") == "T9"
    path.write_text("[1]")
    with pytest.raises(ConfigError, match="state file"):
        Gaps(path)


def test_a_name_of_another_program_cannot_forge_a_field() -> None:
    line = line_of("a b/c,good=true x", document(7))
    assert line.startswith("plc,device=a\\ b,name=c\\,good\\=true\\ x value=7.0,good=true ")
    line = line_of("a/b\nplc,device=oven", document(7) | {"origin": "held,x=1 good"})
    assert line.startswith(
        "plc,device=a,name=b\\ plc\\,device\\=oven,origin=held\\,x\\=1\\ good value=7.0,good=true "
    )


def test_lines_may_be_read_by_head() -> None:
    """As docs/bridges.md has it: nothing is said of the reader that has gone."""
    endpoint = free_endpoint()
    words = [sys.executable, "-m", "gateway", "bridge", "influx", "--connect", endpoint]
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        Program("bash", "-c", f"{shlex.join(words)} --every 0.1 | head -1") as shell,
    ):
        shell.says("gateway demo is there")
        while shell.running:  # the bridge notices at its next line
            gateway.put("mixer/speed", time.monotonic())
            time.sleep(0.05)
        shell.ended()
    assert any(line.startswith("plc,device=mixer") for line in shell.lines)
    assert not [line for line in shell.lines if "Traceback" in line or "closed" in line]
