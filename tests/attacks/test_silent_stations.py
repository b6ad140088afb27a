"""Silent stations on the line of a real gateway: they keep nobody dark, and are seen again soon."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gateway.engine.device.longer_reads import MOST_CHOICES
from gateway.protocols.driver import Span
from gateway.protocols.vigor.devices import cover
from gateway.stations.vigor import VigorStation
from tests.e2e.processes import started, until, write_config
from tests.zenoh_peer import free_endpoint

STATIONS, HEALTHY = 6, 6
HOURLY = 8000


class DeviceServer:
    """A device server with six PLCs behind it, of which only those in `speaking` reply."""

    def __init__(self, *speaking: int, latency: float = 0.0) -> None:
        self.speaking = set(speaking)
        self.heard: list[tuple[float, int, bytes]] = []  # time, station, request
        self.opened: list[int] = []  # by connection: the requests before it
        self.latency = latency
        self._plcs = {number: VigorStation(number) for number in range(1, STATIONS + 1)}
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._peer: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.reset()
        self._thread.join()

    def reset(self) -> None:
        """Drops the connection."""
        if self._peer is not None:
            with suppress(OSError):
                self._peer.shutdown(socket.SHUT_RDWR)

    def asked(self, station: int, since: int = 0) -> int:
        """Counts the requests to the station."""
        return sum(number == station for _, number, _ in self.heard[since:])

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                self._peer, _ = self._listener.accept()
                self.opened.append(len(self.heard))
                with self._peer as peer, suppress(OSError):
                    while data := peer.recv(4096):
                        self._hear(peer, data)

    def _hear(self, peer: socket.socket, data: bytes) -> None:
        station = int(data[1:3], 16)
        self.heard.append((time.monotonic(), station, data))
        if station in self.speaking:
            reply = b"".join(self._plcs[station].hear(data, 0.0))
            if self.latency:
                time.sleep(self.latency)
            peer.sendall(reply)


@contextmanager
def running(
    folder: Path, server: DeviceServer, tags: dict[str, Any], **settings: Any
) -> Iterator[None]:
    """Runs a gateway on the line; the silent stations are the first in its file."""
    devices = {
        f"plc{number}": {"protocol": "vigor", "station": number, "tags": tags, **settings}
        for number in range(1, STATIONS + 1)
    }
    line = {"port": f"tcp://127.0.0.1:{server.port}", "baudrate": 19200, "devices": devices}
    config = write_config(folder / "config.yaml", free_endpoint(), {"hall": line})
    try:
        with started(config):
            yield
    finally:
        server.close()


def test_silent_stations_first_in_the_file_do_not_keep_the_last_one_dark(tmp_path: Path) -> None:
    """Each took 1.2 s: its reply time-out and the wait for a late reply."""
    server = DeviceServer(HEALTHY)
    tags = {"speed": {"address": "D10", "every": "100ms"}}
    with running(tmp_path, server, tags, reply_timeout="600ms", late_guard="600ms"):
        until(lambda: server.asked(HEALTHY) >= 2, "the healthy station is polled")
        begun = server.heard[0][0]
        second = [at for at, station, _ in server.heard if station == HEALTHY][1]
        assert second - begun < 1.2 * (STATIONS - 1) / 2
        before = len(server.opened)
        server.reset()
        until(lambda: len(server.opened) > before, "the line is open again")
        first = server.opened[before]
        until(lambda: len(server.heard) > first, "a station is asked")
        assert server.heard[first][1] == HEALTHY


def test_a_silent_station_is_asked_every_few_seconds_and_read_when_it_returns(
    tmp_path: Path,
) -> None:
    """All five together got a twentieth of the wire: one probe in five seconds."""
    server = DeviceServer(HEALTHY)
    tags = {"speed": {"address": "D10", "every": "100ms"}}
    with running(tmp_path, server, tags, reply_timeout="200ms", late_guard="50ms"):
        silent = [number for number in range(1, STATIONS + 1) if number != HEALTHY]
        until(lambda: all(server.asked(n) >= 2 for n in silent), "all are offline")
        since = len(server.heard)
        until(lambda: server.asked(HEALTHY, since) >= 35, "the healthy station is polled")
        assert all(server.asked(number, since) for number in silent)
        since = len(server.heard)
        server.speaking.add(2)
        until(lambda: server.asked(2, since) >= 3, "the returned station is polled")
        assert server.asked(HEALTHY, since) < 80  # at 10 a second


def test_a_tag_of_once_an_hour_is_read_soon_on_an_overloaded_line(tmp_path: Path) -> None:
    """It was read after an hour, because every other poll had an earlier deadline."""
    server = DeviceServer(*range(1, STATIONS + 1), latency=0.01)
    tags: dict[str, Any] = {f"t{n}": {"address": f"D{500 * n}", "every": "100ms"} for n in range(6)}
    tags["hours"] = {"address": f"D{HOURLY}", "every": "1h"}
    with running(tmp_path, server, tags):
        polled = STATIONS * 60
        until(lambda: len(server.heard) >= polled, "the line is busy")
        hourly = set[bytes]()
        for longer in range(MOST_CHOICES):  # it may be read with addresses before it
            place = cover(Span("D", HOURLY - longer, 1))
            assert place is not None
            hourly.add(f"{place.address:04X}".encode())
        seen = {station for _, station, data in server.heard if any(a in data for a in hourly)}
        assert seen == set(range(1, STATIONS + 1)), {data for *_, data in server.heard}
