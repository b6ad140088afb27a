"""Kills bridges, brokers and gateways at random: `make bridges HOURS=1 SEED=7`.

A played gateway knows the truth: each value that it ever gave, and until when it was good. Clients
at the other end of each bridge show what they have. A value that a client shows as good must be the
present one, or must have been within the last `LATE` seconds: the time in which a broker notices
that a bridge stands still. When all runs again, every client has the present values.
"""

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, Self

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from tests.bridges.played import PlayedGateway
from tests.bridges.sparkplug_host import SparkplugHost
from tests.conftest import needs
from tests.e2e.processes import Program, free_port, listens, slowed, until
from tests.zenoh_peer import free_endpoint

DEVICES = ("a", "b", "c")
TAGS: dict[str, dict[str, Any]] = {
    f"{device}/{tag}": {"type": "int32"} for device in DEVICES for tag in ("one", "two", "three")
}
LATE = 30.0  # seconds: keep-alive, lease, expiry
AGAIN = 60.0  # seconds until all is right again


class Truth:
    """What the gateway says, and said: by key, the values and until when each was good."""

    def __init__(self) -> None:
        self.now: dict[str, int | None] = dict.fromkeys(TAGS)
        self._until: dict[tuple[str, int], float] = {}

    def set(self, key: str, value: int | None) -> None:
        if (before := self.now[key]) is not None:
            self._until[key, before] = time.monotonic()
        self.now[key] = value

    def allows(self, key: str, value: object, late: float) -> bool:
        """Returns False for a value that was never good, or not for so long."""
        if value is None or value == self.now[key]:
            return True
        since = self._until.get((key, value)) if isinstance(value, int) else None
        return since is not None and time.monotonic() - since < late


class JsonClient:
    """Shows a value while it is good, and the bridge `online`."""

    def __init__(self, port: int) -> None:
        self._values: dict[str, int | None] = dict.fromkeys(TAGS)
        self._online = False
        self._client = Client(
            CallbackAPIVersion.VERSION2, "reader", protocol=MQTTProtocolVersion.MQTTv5
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.on_connect = lambda *_: self._subscribe()
        self._client.on_disconnect = lambda *_: self._forget()
        self._client.on_message = self._arrived
        self._client.connect_async("127.0.0.1", port, 10)

    def __enter__(self) -> Self:
        self._client.loop_start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def shown(self) -> dict[str, object]:
        return dict(self._values) if self._online else {}

    def _subscribe(self) -> None:
        self._client.subscribe("plant/#", 1)

    def _forget(self) -> None:
        self._online, self._values = False, dict.fromkeys(TAGS)

    def _arrived(self, _client: object, _data: object, message: MQTTMessage) -> None:
        key = message.topic.removeprefix("plant/")
        if key == "@bridge":
            self._online = message.payload == b"online"
        elif key in TAGS:
            known = json.loads(message.payload)
            self._values[key] = known["value"] if known["quality"] == "good" else None


class InfluxServer:
    """Keeps the last line of each tag; answers 503 while it is `ill`."""

    def __init__(self) -> None:
        self.ill = False
        self._values: dict[str, tuple[int, int | None]] = {}
        self.good: list[tuple[str, int]] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                self.send_response(503 if server.ill else 204)
                self.end_headers()
                if not server.ill:
                    server.take(body)

            def log_message(self, *_: object) -> None:
                pass

        self._http = HTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._http.serve_forever)
        self.url = f"http://127.0.0.1:{self._http.server_port}/write"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._http.shutdown()
        self._thread.join()
        self._http.server_close()

    def take(self, body: str) -> None:
        for line in body.splitlines():
            if not line.startswith("plc,"):
                continue
            about, fields, at = line.split(" ")
            device, name = (part.partition("=")[2] for part in about.split(",")[1:3])
            is_good = "good=true" in fields
            value = int(float(fields.partition("value=")[2].partition(",")[0])) if is_good else None
            key = f"{device}/{name}"
            if value is not None:
                self.good.append((key, value))
            if int(at) >= self._values.get(key, (0, None))[0]:
                self._values[key] = int(at), value

    def shown(self) -> dict[str, object]:
        return {key: value for key, (_, value) in self._values.items()}


class Campaign:
    """One plant with its bridges. `broken`: sentences about what was shown and was not so."""

    def __init__(self, folder: Path, seed: int, expire: int = 20) -> None:
        self.done: Counter[str] = Counter()
        self.broken: list[str] = []
        self._folder, self._random, self._expire = folder, random.Random(seed), expire
        self._counter = 0
        self._truth = Truth()
        self._port, self._endpoint = free_port(), free_endpoint()
        self._programs: dict[str, Program] = {}
        self._stack = ExitStack()
        self._is_there, self._charts_are_old = True, False
        self._offline: set[str] = set()

    def __enter__(self) -> Self:
        enter = self._stack.enter_context
        self._gateway = enter(PlayedGateway(self._endpoint, TAGS))
        self._influx = enter(InfluxServer())
        self.start("broker")
        self._json = enter(JsonClient(self._port))
        self._host = enter(SparkplugHost(self._port, "g", "n"))
        for name in ("mqtt", "sparkplug", "influx"):
            self.start(name)
        return self

    def __exit__(self, *_error: object) -> None:
        for name in list(self._programs):
            self.kill(name)
        self._stack.close()

    # -- programs --

    def start(self, name: str) -> None:
        broker = f"mqtt://127.0.0.1:{self._port}"
        if name == "broker":
            store = self._folder / "broker"
            store.mkdir(exist_ok=True)
            setup = self._folder / "mosquitto.conf"
            setup.write_text(
                f"listener {self._port} 127.0.0.1\nallow_anonymous true\nuser root\n"
                f"persistence true\npersistence_location {store}/\nautosave_interval 1\n"
                "autosave_on_changes true\n"
            )
            self._programs[name] = Program(needs("mosquitto"), "-c", setup)
            until(lambda: listens(self._port), "the broker listens")
            return
        options = {
            "mqtt": ("mqtt", "--broker", broker, "--expire", self._expire),
            "sparkplug": ("mqtt", "--broker", broker, "--sparkplug", "g", "--node", "n"),
            "influx": (
                *("influx", "--to", self._influx.url, "--every", 0.2),
                *("--state", self._folder / "influx.json"),
            ),
        }[name]
        command = (sys.executable, "-m", "gateway", "bridge", *options)
        self._programs[name] = Program(*command, "--connect", self._endpoint)

    def kill(self, name: str, by: signal.Signals = signal.SIGKILL) -> None:
        if program := self._programs.pop(name, None):
            if program.running:
                program.end(by)
            else:
                self.broken.append(f"{name} ended by itself: {program.lines[-30:]}")

    # -- what happens --

    def step(self) -> str:
        """Does one thing at random, and returns its name."""
        bridges = ("mqtt", "sparkplug", "influx")
        what: dict[str, Callable[[], object]] = {
            "bridge killed": lambda: self._again([self._random.choice(bridges)]),
            "bridge ended": lambda: self._again([self._random.choice(bridges)], signal.SIGTERM),
            "broker killed": lambda: self._again(["broker"]),
            "both killed": lambda: self._again(["broker", self._random.choice(bridges[:2])]),
            "all killed": lambda: self._again(["broker", *bridges]),
            "bridge stands still": lambda: self._held(self._random.choice(bridges)),
            "gateway goes": self._leave,
            "device silent": self._silent,
            "server ill": self._ill,
        }
        name = self._random.choice(list(what))
        what[name]()
        self.done[name] += 1
        return name

    def run_for(self, seconds: float) -> None:
        """Values change, and the clients are looked at, all the time."""
        end = time.monotonic() + seconds
        while True:
            self.change()
            self.judge()
            if time.monotonic() >= end:
                return
            time.sleep(0.05)

    def change(self) -> None:
        key = self._random.choice(list(TAGS))
        if not self._is_there or key[0] in self._offline:
            return
        if self._random.random() < 0.1:
            self._truth.set(key, None)
            self._gateway.put(key, None, "overdue")
        else:
            self._counter += 1
            self._truth.set(key, self._counter)
            self._gateway.put(key, self._counter)

    def judge(self) -> None:
        late = slowed(LATE)
        shown_by = self._shown()
        if self._charts_are_old:  # of a bridge that has gone: only the age of a line tells
            del shown_by["influx"]
        for name, shown in shown_by.items():
            for key, value in shown.items():
                if not self._truth.allows(key, value, late):
                    now = self._truth.now[key]
                    self.broken.append(f"{name} shows {key} = {value} as good; it is {now}")
        for key, value in self._influx.good:
            if not self._truth.allows(key, value, float("inf")):
                self.broken.append(f"influx got {key} = {value}, which never was")
        self._influx.good.clear()
        self.broken += [f"sparkplug: {rule}" for rule in self._host.wrong]
        self._host.wrong.clear()

    def settle(self, within: float = AGAIN) -> None:
        """All runs: the clients must have the present values."""
        end = time.monotonic() + slowed(within)
        while lacking := self._lacking():
            if time.monotonic() > end:
                self.broken.append(f"after {within} s these are not shown: {lacking}")
                return
            self.judge()
            time.sleep(0.05)
        self._charts_are_old = False

    def nothing_good(self) -> bool:
        """Returns True if the clients of the broker show nothing as good."""
        shown = self._shown()
        return not any(
            value is not None for name in ("mqtt", "sparkplug") for value in shown[name].values()
        )

    def _lacking(self) -> list[str]:
        return [
            f"{name} {key} {shown.get(key)} {value}"
            for name, shown in self._shown().items()
            for key, value in self._truth.now.items()
            if shown.get(key) != value
        ]

    def _shown(self) -> dict[str, dict[str, object]]:
        return {
            "mqtt": self._json.shown(),
            "sparkplug": dict(self._host.values),
            "influx": self._influx.shown(),
        }

    def _pause(self) -> None:
        self.run_for(self._random.choice((0.2, 2, 8, 25)))

    def _again(self, names: list[str], by: signal.Signals = signal.SIGKILL) -> None:
        for name in names:
            self.kill(name, by)
        self._charts_are_old = "influx" in names
        self._random.shuffle(names)
        for name in names:
            self._pause()
            self.start(name)

    def _held(self, name: str) -> None:
        with stopped(self._programs[name]):
            self._charts_are_old = name == "influx"
            self.run_for(self._random.choice((2, 8, 40)))

    def _leave(self) -> None:
        self._gateway.leave()
        self._is_there = False
        for key in TAGS:
            self._truth.set(key, None)
        self._pause()
        for key in TAGS:  # what happened meanwhile is in the first answer
            self._counter += 1
            self._gateway.documents[key] |= {"value": None, "quality": "bad", "reason": "starting"}
        self._offline.clear()
        self._gateway.arrive()
        self._is_there = True

    def _silent(self) -> None:
        device = self._random.choice([name for name in DEVICES if name not in self._offline])
        self._offline.add(device)
        for key in TAGS:
            if key[0] == device:
                self._truth.set(key, None)
                self._gateway.put(key, None, "no-reply")
        self._gateway.offline(device)
        self._pause()
        if device in self._offline:
            self._offline.remove(device)
            self._gateway.online(device)

    def _ill(self) -> None:
        self._influx.ill = self._charts_are_old = True
        self._pause()
        self._influx.ill = False


@contextmanager
def stopped(program: Program) -> Iterator[None]:
    os.kill(program.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(program.pid, signal.SIGCONT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    end = time.monotonic() + given.hours * 3600
    with tempfile.TemporaryDirectory() as folder, Campaign(Path(folder), given.seed) as campaign:
        campaign.settle()
        while time.monotonic() < end and len(campaign.broken) < 20:
            name = campaign.step()
            campaign.settle()
            print(time.strftime("%H:%M:%S"), name, *campaign.broken[-3:], flush=True)
        print(dict(campaign.done), f"{sum(campaign.done.values())} faults")
        print("\n".join(dict.fromkeys(campaign.broken)) or "nothing was good that was not")
    sys.exit(bool(campaign.broken))


if __name__ == "__main__":
    main()
