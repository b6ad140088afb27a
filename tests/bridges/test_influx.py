"""`bridge influx` with InfluxDB, and with a server that fails."""

import json
import signal
import sys
import threading
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import groupby
from pathlib import Path
from typing import Any

from tests.bridges.conftest import bridge
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import ROOT, Program, free_port, listens, until
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64"},
    "mixer/total": {"type": "int64"},
    "mixer/name": {"type": "string[8]"},
    "mixer/steps": {"type": "float32[2]", "length": 2},
}


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
        """Returns the rows of an answer."""
        about = urllib.parse.urlencode({"q": text, "db": "plant"}).encode()
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
            assert datetime.fromisoformat(time) == datetime.fromisoformat(sent)
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
            assert note.startswith("plc_bridge lost=2i,refused=1i ")
