"""Values through each bridge: changes a second that arrive, CPU of the bridge, what is missing.

    python -m benchmarks.bridges [--tags 20000] [--rates 2000 5000 10000 20000] [--seconds 10]

A played gateway publishes changes of all tags in turn, one message each. As a gateway does, it puts
values again that a full link may have dropped; `--once`: it does not. `--hold 2`: the bridge stands
still for so many seconds at the end of each rate, so that its link is full. The other end is
mosquitto with mosquitto_sub, or a server that takes lines. A bridge keeps the last value of a tag
that waits: so it leaves out changes before it leaves the present behind. `late`: from the last
change until the other end has all present values. Needs mosquitto and its clients.
"""

import argparse
import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

from gateway.bridges.mqtt.sparkplug.messages import Payload
from gateway.northbound.publishing.slow_puts import SlowPuts
from tests.bridges.campaign_clients import InfluxServer
from tests.bridges.played import PlayedGateway
from tests.conftest import needs
from tests.e2e.processes import Program, free_port, held, listens, until
from tests.zenoh_peer import free_endpoint

PER_DEVICE = 1000
DOORS = ("mqtt", "sparkplug", "influx")


class Figures(NamedTuple):
    """Changes a second sent and arrived, share of one processor, seconds, tags; puts of this door
    until then that found a full link."""

    sent: float
    arrived: float
    cpu: float
    late: float
    missing: int
    slow: int


class Plant:
    """A played gateway with many tags. `values`: what it published last."""

    def __init__(self, endpoint: str, tags: int, *, once: bool) -> None:
        self.losses = SlowPuts(float("inf") if once else 0.05)
        names = [f"d{n // PER_DEVICE}/t{n % PER_DEVICE}" for n in range(tags)]
        about: dict[str, dict[str, Any]] = {name: {"type": "int32"} for name in names}
        self.gateway = PlayedGateway(endpoint, about)
        self.values: dict[str, int] = dict.fromkeys(names, 0)
        self._names, self._next = names, 0

    def publish(self, count: int) -> None:
        for _ in range(count):
            name = self._names[self._next % len(self._names)]
            self._next += 1
            self.values[name] = self._next
            self._put(name)

    def _put(self, name: str) -> None:
        began = time.monotonic()
        self.gateway.put(name, self.values[name])
        now = time.monotonic()
        self.losses.sent([name], now - began, now)

    def again(self) -> None:
        """Puts values again when it is time for it, until the link is full again."""
        names, congested = self.losses.due(time.monotonic()), self.losses.congested
        for name in names:
            if self.losses.congested == congested:
                self._put(name)

    def publish_for(self, seconds: float, rate: int) -> float:
        """Returns the rate that was reached."""
        began, sent = time.monotonic(), 0
        while (passed := time.monotonic() - began) < seconds:
            due = int(passed * rate) - sent
            self.publish(min(due, 500))
            sent += min(due, 500)
            self.again()
            time.sleep(0.005)
        return sent / (time.monotonic() - began)


class Reader:
    """The other end. Counts changes, and has the last value of each tag."""

    def __init__(self, door: str, port: int, file: Path) -> None:
        self.server = InfluxServer()
        self._door, self._file = door, file
        self._form = "%t %p" if door == "mqtt" else "%t %x"
        self._topic = "plant/#" if door == "mqtt" else "spBv1.0/#"
        self._port, self._keys = port, dict[int, str]()
        self._at, self.count, self.values = 0, 0, dict[str, int]()

    def start(self, stack: ExitStack) -> None:
        stack.enter_context(self.server)
        if self._door != "influx":
            command = [needs("mosquitto_sub"), "-p", str(self._port), "-t", self._topic]
            out = stack.enter_context(self._file.open("wb"))
            process = subprocess.Popen([*command, "-F", self._form], stdout=out)
            stack.callback(process.wait)
            stack.callback(process.kill)

    def look(self) -> None:
        """Takes what has arrived since the last look."""
        if self._door == "influx":
            self._take(self.server.good)
            self.server.good.clear()
            return
        with self._file.open("rb") as file:
            file.seek(self._at)
            data = file.read()
        data = data[: data.rfind(b"\n") + 1]
        self._at += len(data)
        for line in data.decode().splitlines():
            topic, _, payload = line.partition(" ")
            take = self._json if self._door == "mqtt" else self._sparkplug
            take(topic, payload)

    def _take(self, found: Sequence[tuple[str, int]]) -> None:
        self.count += len(found)
        self.values.update(found)

    def _json(self, topic: str, payload: str) -> None:
        if payload.startswith('{"value": ') and '"good"' in payload:
            self._take([(topic.removeprefix("plant/"), int(payload[10:].partition(",")[0]))])

    def _sparkplug(self, topic: str, payload: str) -> None:
        message = Payload()
        message.ParseFromString(bytes.fromhex(payload))
        device = topic.split("/")[-1]
        if "/DBIRTH/" in topic:
            self._keys |= {one.alias: f"{device}/{one.name}" for one in message.metrics}
        found = [one for one in message.metrics if one.alias and not one.is_null]
        self._take([(self._keys[one.alias], one.int_value) for one in found])


def measure(
    door: str,
    tags: int,
    rates: Sequence[int],
    seconds: float,
    *,
    once: bool = False,
    hold: float = 0.0,
) -> list[Figures]:
    endpoint, port = free_endpoint(), free_port()
    found = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plant = Plant(endpoint, tags, once=once)
        stack.enter_context(plant.gateway)
        stack.enter_context(Program(needs("mosquitto"), "-p", port))
        until(lambda: listens(port), "the broker listens")
        reader = Reader(door, port, folder / "read")
        reader.start(stack)
        options = {
            "mqtt": ("mqtt", "--broker", f"mqtt://127.0.0.1:{port}"),
            "sparkplug": ("mqtt", "--broker", f"mqtt://127.0.0.1:{port}", "--sparkplug", "g"),
            "influx": ("influx", "--to", reader.server.url, "--every", "0.2"),
        }[door]
        command = (sys.executable, "-m", "gateway", "bridge", *options, "--connect", endpoint)
        bridge = stack.enter_context(Program(*command))
        plant.publish(tags)

        def present() -> bool:
            reader.look()
            return reader.values == plant.values

        until(present, f"{door} has all tags")
        for rate in rates:
            before, used = reader.count, processor(bridge.pid)
            began = time.monotonic()
            sent = plant.publish_for(seconds, rate)
            with held(bridge.pid) if hold else nullcontext():
                plant.publish_for(hold, rate)
            ended, used = time.monotonic(), processor(bridge.pid) - used
            reader.look()
            arrived = (reader.count - before) / (ended - began)
            while not present() and time.monotonic() < ended + 60:
                plant.again()
                time.sleep(0.05)
            missing = sum(value != reader.values.get(key) for key, value in plant.values.items())
            late = time.monotonic() - ended
            slow = plant.losses.congested
            found.append(Figures(sent, arrived, used / (ended - began), late, missing, slow))
    return found


def processor(pid: int) -> float:
    """Seconds that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tags", type=int, default=20_000)
    parser.add_argument("--rates", type=int, nargs="+", default=[2000, 5000, 10_000, 20_000])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--doors", nargs="+", default=DOORS)
    parser.add_argument("--once", action="store_true")
    parser.add_argument("--hold", type=float, default=0.0)
    given = parser.parse_args()
    load, cores = os.getloadavg()[0], os.cpu_count()
    print(f"{given.tags:,} tags; {cores} processors, load {load:.1f} before")
    print("| bridge | changes/s sent | arrived | CPU of the bridge | late | missing | slow puts |")
    print("|---|---|---|---|---|---|---|")
    for door in given.doors:
        with redirect_stdout(io.StringIO()):  # what the programs said
            how = {"once": given.once, "hold": given.hold}
            found = measure(door, given.tags, given.rates, given.seconds, **how)
        for one in found:
            print(
                f"| {door} | {one.sent:,.0f} | {one.arrived:,.0f} | {one.cpu:.0%} |"
                f" {one.late:.1f} s | {one.missing} | {one.slow} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
