"""Faults that an operator meets, made for real: `make operator` prints what each place says.

Each fault has a gateway, a router and a station of its own, in other processes. For 25 seconds
after the fault the program reads the log, the API behind the status page, the metrics and what a
webhook was sent, and then runs `plc-gateway status`. Its last table has one row for each fault. It
ends with exit code 1 when a place does not name the cause. docs/find-a-fault.md and docs/walks.md
have the result.
"""

import argparse
import asyncio
import io
import os
import pty
import random
import re
import signal
import sys
import tempfile
import threading
import time
import tty
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stdout, suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import orjson

from gateway.stations.vigor import VigorStation
from tests.e2e.processes import Program, free_port, plc_gateway, station, vigor_line, write_config
from tests.e2e.pty_modem import PtyModem
from tests.transport.modem import ModemModel
from tests.zenoh_peer import free_endpoint

WITHIN = 25.0  # seconds: faults of the gateway itself are told after some 20
LOOK_EVERY = 0.25
DEFAULT = {"reply_timeout": "500ms"}  # as without it: the seconds are those of a plain file
HEALTHY_WITHIN = 300.0  # seconds; never waited for when all is well
SETTLED = 3.0  # the page shows state of up to two seconds ago
DISK = 8  # MB
ROUTER = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
with zenoh.open(config):
    print("ready", flush=True)
    sys.stdin.read()
"""
# The command itself; SIGUSR1 sets its wall clock back by ten minutes.
RUN = """
import signal, time
real, shift = time.time_ns, [0]
time.time_ns = lambda: real() - shift[0]
signal.signal(signal.SIGUSR1, lambda *_: shift.__setitem__(0, 600 * 10**9))
from gateway.cli.main import main
main()
"""
_METRICS = re.compile(
    r'^plc_gateway_((?:alarms{state="(?!normal)|faults|warnings|line_up|history_ok|ready|'
    r'device_state{.*state="(?:silent|failing|starting)"|zenoh_links|clock_jumps_total|'
    r"transfer_works|line_calls_total)\S*) (\S+)$",
    re.MULTILINE,
)


class Modem(threading.Thread):
    """A modem on a pseudo terminal; a PLC answers its calls until the number is busy."""

    def __init__(self, stack: ExitStack) -> None:
        super().__init__(daemon=True)
        far = VigorStation(1)
        self.model = ModemModel(answers=lambda data: b"".join(far.hear(data, 0.0)))
        self._ready, self._over = threading.Event(), threading.Event()
        self.start()
        self._ready.wait(HEALTHY_WITHIN)
        stack.callback(self._over.set)

    def run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        async with PtyModem(self.model) as modem:
            self.path = modem.path
            self._ready.set()
            await asyncio.to_thread(self._over.wait)


class Told(BaseHTTPRequestHandler):
    """The receiver of a webhook."""

    server: "Receiver"

    def do_POST(self) -> None:
        sent = orjson.loads(self.rfile.read(int(self.headers["Content-Length"])))
        for one in sent["alarms"]:
            self.server.told.append(f"{one['alarm']} {one['event']}: {one['text']}")
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """The log of the gateway is enough."""


class Receiver(HTTPServer):
    """Serves in a thread."""

    def __init__(self, stack: ExitStack) -> None:
        super().__init__(("127.0.0.1", 0), Told)
        self.told: list[str] = []
        threading.Thread(target=self.serve_forever, daemon=True).start()
        stack.callback(self.server_close)
        stack.callback(self.shutdown)


class Plant:
    """A router, a station on a pty, and a gateway that serves it.

    `word`: `transfer` or `modem`, for a plant with one.
    """

    def __init__(self, folder: Path, stack: ExitStack, word: str) -> None:
        self.folder = folder
        self.stack = stack
        self.port = free_port()
        self.link = folder / "tty"
        self.endpoint, self.router_at = free_endpoint(), free_endpoint()
        self.disk = folder / "disk"
        self.disk.mkdir()
        alarm = {"high": 80, "text": "mixer too fast"}
        tags = {
            "speed": {"address": "D10", "alarm": alarm, "history": True, "publish": "always"},
            "recipe": {"address": "D500", "write": {"min": 20, "max": 250}},
            "level": {"address": "D11"},
        }
        lines, extra = {"hall": vigor_line(str(self.link), tags, **DEFAULT)}, {}
        if word == "transfer":
            extra["transfers"] = [{"from": "mixer/level", "to": "mixer/recipe"}]
        if word == "modem":
            self.modem = Modem(stack)
            settings = {"number": "4393", "guard": "100ms", "idle": "200ms", "retry_pause": "1s"}
            often = {"address": "D100", "every": "3s"}
            pump = {"protocol": "vigor", "station": 1, "tags": {"level": often}}
            port = f"modem:{self.modem.path}"
            lines["pumps"] = {"port": port, "modem": settings, "devices": {"pump": pump}}
        self.receiver = Receiver(stack)
        self.config = write_config(
            folder / "plant.yaml",
            self.endpoint,
            lines,
            zenoh={"prefix": "op", "listen": [self.endpoint], "connect": [self.router_at]},
            gateway={"name": "op"},
            history={"path": str(self.disk / "history.db")},
            alarms={"path": str(folder / "alarms.json")},
            notify={
                "webhook": {"url": f"http://127.0.0.1:{self.receiver.server_port}/"},
                "rules": [{"to": ["webhook"], "pause": "1s"}],
                "path": str(folder / "notify.json"),
            },
            **extra,
            web={"listen": f"127.0.0.1:{self.port}"},
        )
        python = sys.executable
        self.router = stack.enter_context(Program(python, "-c", ROUTER, self.router_at))
        self.router.says("ready")
        self.plc = stack.enter_context(station("pty", str(self.link)))
        self.plc.tell("set 1 D 10 85")  # an alarm, so that its fate is seen
        self.plc.tell("set 1 D 11 30")
        self.gateway = self.start()

    def start(self) -> Program:
        """Starts the gateway on a small disk, where this user may mount one."""
        run = f"{sys.executable} -c '{RUN}' run {self.config}".replace("'", "'\"'\"'")
        place = f"mount -t tmpfs -o size={DISK}m small {self.disk}"
        if os.geteuid() == 0:
            run = f"exec unshare --mount bash -c '{place} && exec {run}'"
        else:
            run = f"exec bash -c '{run}'"
        self.gateway = self.stack.enter_context(Program("bash", "-c", run))
        until = time.monotonic() + HEALTHY_WITHIN
        while not self._healthy():
            if time.monotonic() > until:
                raise AssertionError("\n".join(self.gateway.lines))
            time.sleep(LOOK_EVERY)
        return self.gateway

    def _healthy(self) -> bool:
        found = self.seen()
        good = found.get("quality") == "good" and found["alarms"] and self.receiver.told
        return bool(good and "router" in found["links"] and found["history"] == "ok")

    def ask(self, path: str) -> bytes | None:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=2) as reply:
                found: bytes = reply.read()
                return found
        except (OSError, urllib.error.HTTPError):
            return None

    def seen(self) -> dict[str, Any]:
        """Returns what the page and the metrics show now."""
        status, alarms, tags = (self.ask(f"/api/{name}") for name in ("status", "alarms", "tags"))
        if status is None or alarms is None or tags is None:
            return {"page": ["no connection to the gateway"], "metrics": {}}
        found, listed = orjson.loads(status), orjson.loads(alarms)["alarms"]
        speed = orjson.loads(tags)["tags"][0]
        reason = speed.get("reason")
        return {
            "page": [
                *found["faults"],
                *found["warnings"],
                *(f"alarm {one['alarm']}: {one['state']}, {one['quality']}" for one in listed),
                f"mixer/speed: {speed['quality']}{f' {reason}' if reason else ''}",
                f"Zenoh: {', '.join(found['zenoh']['to']) or 'no connection'}",
            ],
            "alarms": listed,
            "quality": speed["quality"],
            "links": found["zenoh"]["to"],
            "history": found["history"]["state"],
            "metrics": dict(_METRICS.findall((self.ask("/metrics") or b"").decode())),
        }


# Each fault, as a function of a healthy plant.


def dead_device(plant: Plant) -> None:
    plant.plc.tell("mute 1")


def port_gone(plant: Plant) -> None:
    plant.plc.tell("deaf")


def noise(plant: Plant) -> None:
    """Another end of the cable answers each request with noise, as two swapped wires do."""
    plant.plc.tell("deaf")
    plant.link.unlink(missing_ok=True)
    master, slave = pty.openpty()
    tty.setraw(slave)
    plant.link.symlink_to(os.ttyname(slave))
    chance = random.Random(1)

    def answer() -> None:
        with suppress(OSError):  # the master is closed at the end
            while os.read(master, 1000):
                os.write(master, chance.randbytes(20))

    threading.Thread(target=answer, daemon=True).start()
    plant.stack.callback(os.close, slave)
    plant.stack.callback(os.close, master)


def router_gone(plant: Plant) -> None:
    plant.router.end(signal.SIGKILL)


def disk_full(plant: Plant) -> None:
    ballast = Path(f"/proc/{plant.gateway.pid}/root{plant.disk}/ballast")
    with ballast.open("ab", buffering=0) as file:
        for size in (65536, 4096, 1):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))


def restart(plant: Plant) -> None:
    """It starts again a second later; meanwhile the page has no connection."""
    plant.gateway.end(signal.SIGKILL)
    again = threading.Timer(1.0, plant.start)
    again.start()
    plant.stack.callback(again.join)


def clock_jump(plant: Plant) -> None:
    os.kill(plant.gateway.pid, signal.SIGUSR1)


def same_name(plant: Plant) -> None:
    """A copy of the file on another machine: other ports, the same router."""
    other = orjson.loads(plant.config.read_bytes())
    other["zenoh"]["listen"] = [free_endpoint()]
    other["lines"]["hall"]["port"] = "simulator"
    other["history"]["path"] = str(plant.folder / "other.db")
    del other["alarms"], other["web"]
    copy = plant.folder / "copy.yaml"
    copy.write_bytes(orjson.dumps(other))
    done = plc_gateway("run", copy)
    said = [line for line in (done.out + done.err).splitlines() if line][-1]
    plant.gateway.lines.append(f"(the second gateway, exit code {done.code}) {said}")


def transfer_refused(plant: Plant) -> None:
    """The target takes 20 to 250."""
    plant.plc.tell("set 1 D 11 251")


def number_busy(plant: Plant) -> None:
    plant.modem.model.dials = ("BUSY",)


class Case(NamedTuple):
    """`place`: the first one that names the cause, by a text with each of `names`."""

    make: Callable[[Plant], None]
    names: tuple[str, ...]
    place: str = "page, API"


FAULTS = {
    "dead device": Case(dead_device, ("mixer", "check power, wiring")),
    "port gone": Case(port_gone, ("line hall is down: ", ": no such port")),
    "A and B swapped, or noise": Case(noise, ("mixer", "if A and B are swapped")),
    "router gone": Case(router_gone, ("Zenoh: not connected to", "its clients get no values")),
    "disk full": Case(disk_full, ("history: the disk is full",)),
    "restart after a kill": Case(restart, ("no connection to the gateway",)),
    "clock set back by 10 min": Case(clock_jump, ("the clock of this machine jumped by -600",)),
    "another gateway of the same name": Case(same_name, ("`gateway.name` must differ",), "log"),
    "transfer refused": Case(transfer_refused, ("is refused: 251 is above the greatest value",)),
    "modem gets no call": Case(number_busy, ("line pumps: the last call failed: ", "BUSY")),
}


def observe(name: str, make: Callable[[Plant], None]) -> Iterator[tuple[str, float, str]]:
    """Makes one fault. Yields place, seconds after the fault, and the new text there."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        plant = Plant(Path(folder), stack, name.split()[0])
        time.sleep(SETTLED)
        before = plant.seen()
        old, lines, told = set(before["page"]), len(plant.gateway.lines), len(plant.receiver.told)
        old_metrics = dict(before["metrics"])
        program = plant.gateway
        began = time.monotonic()
        make(plant)
        while (passed := time.monotonic() - began) < WITHIN or not program.running:
            if plant.gateway is not program:  # a restart may take long
                program, lines = plant.gateway, 0
            for line in program.lines[lines:]:
                yield "log", passed, _plain(line, folder)
            lines = len(program.lines)
            for text in plant.receiver.told[told:]:
                yield "told", passed, text
            told = len(plant.receiver.told)
            now = plant.seen()
            for sentence in now["page"]:
                same = re.sub(r" \(for .*\)|\d+ min ago", "", sentence)
                if same not in old:
                    old |= {same, sentence}
                    yield "page, API", passed, _plain(sentence, folder)
            for metric, value in now["metrics"].items():
                if old_metrics.get(metric) != value:
                    old_metrics[metric] = value
                    yield "metrics", passed, f"{metric} {value.removesuffix('.0')}"
            time.sleep(LOOK_EVERY)
        done = plc_gateway("status", plant.config)
        sentences = [line for line in done.out.splitlines() if line.startswith("  ")]
        shown = sentences or done.err.splitlines()
        shown += [line for line in done.out.splitlines() if line.startswith(("Zenoh", "alarms"))]
        for line in shown:
            yield "status", WITHIN, _plain(" ".join(line.split()), folder)


def _plain(text: str, folder: str) -> str:
    text = re.sub(r"^\d{4}-\S+Z \[(\w+) *\]", r"[\1]", text)
    return re.sub(r"\s+", " ", text.replace(folder, "…")).strip()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="only faults whose names hold one of these")
    words = parser.parse_args().words
    say = partial(print, file=sys.__stdout__, flush=True)
    rows, unnamed = [], []
    for name, case in FAULTS.items():
        if words and not any(word in name for word in words):
            continue
        say(f"\n## {name}\n\n| place | after | says |\n|---|---|---|")
        first: dict[str, str] = {}
        for place, after, text in observe(name, case.make):
            say(f"| {place} | {after:.1f} s | {text} |")
            first.setdefault(place, f"{after:.1f} s | {text}")
            if place == case.place and all(one in text for one in case.names):
                first.setdefault("cause", f"{after:.1f} s | {text}")
        rows.append(f"| {name} | {first.get('cause', '| nothing')} | {first.get('told', '|')} |")
        if not {"cause", "log"} <= {*first}:
            unnamed.append(name)
    print(
        "\n| fault | cause named after | sentence | told after | message |\n|---|---|---|---|---|"
    )
    say("\n".join(rows))
    say(f"\nnot named, or not in the log: {', '.join(unnamed) or 'none'}")
    return 1 if unnamed else 0


if __name__ == "__main__":
    with redirect_stdout(io.StringIO()):  # programs print their output when they end
        sys.exit(main())
