"""Faults that an operator meets, made for real: `make operator` prints what each place says.

Each fault has a gateway, a router and a station of its own, in other processes. For ten seconds
after the fault the program reads the log, the API behind the status page and the metrics, and then
runs `plc-gateway status`. It ends with exit code 1 when no place has said anything of a fault.
docs/find-a-fault.md has the result.
"""

import argparse
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
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import orjson

from tests.e2e.processes import Program, free_port, plc_gateway, station, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

WITHIN = 10.0  # seconds
LOOK_EVERY = 0.25
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
    r'device_state{.*state="(?:silent|failing|starting)"|zenoh_links|clock_jumps_total)\S*) (\S+)$',
    re.MULTILINE,
)


class Plant:
    """A router, a station on a pty, and a gateway that serves it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
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
            "recipe": {"address": "D500", "write": True},
        }
        self.config = write_config(
            folder / "plant.yaml",
            self.endpoint,
            {"hall": vigor_line(str(self.link), tags)},
            zenoh={"prefix": "op", "listen": [self.endpoint], "connect": [self.router_at]},
            gateway={"name": "op"},
            history={"path": str(self.disk / "history.db")},
            alarms={"path": str(folder / "alarms.json")},
            web={"listen": f"127.0.0.1:{self.port}"},
        )
        python = sys.executable
        self.router = stack.enter_context(Program(python, "-c", ROUTER, self.router_at))
        self.router.says("ready")
        self.plc = stack.enter_context(station("pty", str(self.link)))
        self.plc.tell("set 1 D 10 85")  # an alarm, so that its fate is seen
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
        good = found.get("quality") == "good" and found["alarms"]
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
    plant.gateway.end(signal.SIGKILL)
    time.sleep(1.0)  # so long the page has no connection
    plant.start()


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


FAULTS: dict[str, Callable[[Plant], None]] = {
    "dead device": dead_device,
    "port gone": port_gone,
    "A and B swapped, or noise": noise,
    "router gone": router_gone,
    "disk full": disk_full,
    "restart after a kill": restart,
    "clock set back by 10 min": clock_jump,
    "another gateway of the same name": same_name,
}


def observe(name: str, make: Callable[[Plant], None]) -> Iterator[tuple[str, float, str]]:
    """Makes one fault. Yields place, seconds after the fault, and the new text there."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        plant = Plant(Path(folder), stack)
        time.sleep(SETTLED)
        before = plant.seen()
        old, lines = set(before["page"]), len(plant.gateway.lines)
        old_metrics = dict(before["metrics"])
        program = plant.gateway
        began = time.monotonic()
        make(plant)
        if plant.gateway is not program:
            program, lines = plant.gateway, 0
        ends = max(WITHIN, time.monotonic() - began + 1.0)  # a restart may take long
        while (passed := time.monotonic() - began) < ends:
            for line in program.lines[lines:]:
                yield "log", passed, _plain(line, folder)
            lines = len(program.lines)
            now = plant.seen()
            for sentence in now["page"]:
                if sentence not in old:
                    old.add(sentence)
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
    silent = []
    for name, make in FAULTS.items():
        if words and not any(word in name for word in words):
            continue
        print(f"\n## {name}\n\n| place | after | says |\n|---|---|---|", flush=True)
        places = set()
        for place, after, text in observe(name, make):
            places.add(place)
            print(f"| {place} | {after:.1f} s | {text} |", flush=True)
        if "log" not in places:
            silent.append(name)
    print(f"\nnot in the log: {', '.join(silent) or 'none'}")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
