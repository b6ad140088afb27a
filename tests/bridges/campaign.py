"""Kills bridges, brokers and gateways at random: `make bridges HOURS=1 SEED=7`.

A played gateway knows the truth: each value that it ever gave, and until when it was good. Clients
at the other end of each bridge show what they have. A value that a client shows as good must be the
present one, or must have been within the last `LATE` seconds: the time in which a broker notices
that a bridge stands still. When all runs again, every client has the present values.
"""

import argparse
import logging
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from tests.bridges.campaign_clients import DEVICES, TAGS, InfluxServer, JsonClient, OpcuaClient
from tests.bridges.opcua_clients import folder as opcua_folder
from tests.bridges.played import PlayedGateway
from tests.bridges.sparkplug_host import SparkplugHost
from tests.conftest import needs
from tests.e2e.processes import Program, free_port, held, listens, slowed, until
from tests.zenoh_peer import free_endpoint

PEERS = {"mqtt": "broker", "sparkplug": "broker", "influx": "server", "opcua": "scada"}
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


class Campaign:
    """One plant with its bridges. `broken`: sentences about what was shown and was not so."""

    def __init__(self, folder: Path, seed: int, expire: int = 20) -> None:
        self.done: Counter[str] = Counter()
        self.broken: list[str] = []
        self._folder, self._random, self._expire = folder, random.Random(seed), expire
        self._counter = 0
        self._truth = Truth()
        self._port, self._endpoint = free_port(), free_endpoint()
        self._url = f"opc.tcp://127.0.0.1:{free_port()}"
        self._programs: dict[str, Program] = {}
        self._stack = ExitStack()
        self._is_there, self._charts_are_old = True, False
        self._offline: set[str] = set()

    def __enter__(self) -> Self:
        enter = self._stack.enter_context
        self._gateway = PlayedGateway(self._endpoint, TAGS)
        self._influx = enter(InfluxServer())
        opcua_folder(self._folder / "opcua")
        self.start("scada")
        self.start("broker")
        self._json = enter(JsonClient(self._port))
        self._host = enter(SparkplugHost(self._port, "g", "n"))
        for name in PEERS:
            self.start(name)
        return self

    def __exit__(self, *_error: object) -> None:
        for name in [*self._programs, "scada"]:
            self.kill(name)
        self._stack.close()
        self._gateway.close()

    # -- programs --

    def start(self, name: str) -> None:
        broker, opcua = f"mqtt://127.0.0.1:{self._port}", self._folder / "opcua"
        if name == "server":
            self._influx.start()
            return
        if name == "scada":
            self._scada = OpcuaClient(self._url, opcua)
            return
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
            "opcua": (
                *("opcua", "--listen", self._url, "--users", opcua / "users.txt"),
                *("--pki", opcua / "pki"),
            ),
        }[name]
        command = (sys.executable, "-m", "gateway", "bridge", *options)
        self._programs[name] = Program(*command, "--connect", self._endpoint)

    def kill(self, name: str, by: signal.Signals = signal.SIGKILL) -> None:
        if name in ("server", "scada"):
            (self._influx if name == "server" else self._scada).kill()
        elif program := self._programs.pop(name, None):
            if program.running:
                if program.end(by) > 0:
                    self.broken.append(f"{name} did not end well: {program.lines[-30:]}")
            else:
                self.broken.append(f"{name} ended by itself: {program.lines[-30:]}")

    # -- what happens --

    def step(self) -> str:
        """Does one thing at random, and returns its name."""
        bridge = self._random.choice(list(PEERS))
        what: dict[str, Callable[[], object]] = {
            "bridge killed": lambda: self._again([bridge]),
            "bridge ended": lambda: self._again([bridge], signal.SIGTERM),
            "peer killed": lambda: self._again([PEERS[bridge]]),
            "both killed": lambda: self._again([bridge, PEERS[bridge]]),
            "all killed": lambda: self._again([*dict.fromkeys(PEERS.values()), *PEERS]),
            "bridge stands still": lambda: self._held(bridge),
            "gateway goes": self._leave,
            "gateway killed": self._die,
            "device silent": self._silent,
            "server ill": self._ill,
        }
        name = self._random.choice(list(what))
        what[name]()
        about = f"{name}: {bridge}" if name.startswith(("bridge", "peer", "both")) else name
        self.done[about] += 1
        return about

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
        """Returns True if no client shows a good value, charts apart."""
        shown = self._shown()
        del shown["influx"]
        return not any(value is not None for of in shown.values() for value in of.values())

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
            "opcua": dict(self._scada.watched),
            "opcua, read": dict(self._scada.read),
        }

    def _pause(self) -> None:
        self.run_for(self._random.choice((0.2, 2, 8, 25)))

    def _again(self, names: list[str], by: signal.Signals = signal.SIGKILL) -> None:
        for name in names:
            self.kill(name, by)
        self._charts_are_old = "influx" in names or "server" in names
        self._random.shuffle(names)
        for name in names:
            self._pause()
            self.start(name)

    def _held(self, name: str) -> None:
        with held(self._programs[name].pid):
            self._charts_are_old = name == "influx"
            self.run_for(self._random.choice((2, 8, 40)))

    def _die(self) -> None:
        self._gateway.close()
        self._away()
        self._gateway = PlayedGateway(self._endpoint, TAGS)
        self._is_there = True

    def _away(self) -> None:
        self._is_there = False
        self._offline.clear()
        for key in TAGS:
            self._truth.set(key, None)
        self._pause()

    def _leave(self) -> None:
        self._gateway.leave()
        self._away()
        for key in TAGS:  # what happened meanwhile is in the first answer
            self._gateway.documents[key] |= {"value": None, "quality": "bad", "reason": "starting"}
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # a lost connection is a page there
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
