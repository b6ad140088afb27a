"""What waits for what on a slow link: `python -m benchmarks.slow_link --samples 1200000`.

A gateway process has a history of `--samples` samples, whose answer is 100 MB. A client behind a
link of `--mbit` reads it, page after page. Meanwhile another client, on a fast link, writes a bit
four times a second: each write makes an outcome, a value and an alarm. Printed: how much later than
its time each of them arrived over the slow link, without and beside the answer. With `--gateway`
the gateway is that of another checkout; with `--two` the slow client has a second link, for urgent
messages; with `--packed` Zenoh compresses. The slow way is a network namespace, which needs root;
with `--mbit 0` it is the loopback.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import zenoh

from benchmarks.history_queries import write
from gateway.config import ZenohConfig, ZenohMode, load
from gateway.northbound.session.session_settings import configure
from tests.zenoh_peer import free_port

ROOT = Path(__file__).parents[1]
HOST, GUEST = "10.77.0.1", "10.77.0.2"
NAME = "plc-slow"  # of the namespace, and of the interfaces
KINDS = {"alarms/mixer/door": "alarm", "/writes": "outcome", "plant/mixer/door": "value"}
EVERY = 0.25  # seconds from one write to the next


def plant_file(folder: Path, endpoints: Sequence[str]) -> Path:
    tags = {f"t{n}": {"address": f"D{n}", "history": True} for n in range(50)}
    tags["door"] = {"address": "M1", "write": True, "every": "100ms", "alarm": {"on": True}}
    mixer = {"protocol": "vigor", "station": 1, "tags": tags}
    file = {
        "gateway": {"name": "demo"},
        "zenoh": {"prefix": "plant", "listen": list(endpoints), "config_file": "zenoh.json5"},
        "history": {"path": "history.db", "max_size": "1GB"},
        "lines": {"hall": {"port": "simulator", "devices": {"mixer": mixer}}},
    }
    unicast = {"max_links": 2, "compression": {"enabled": True}}  # where the client has it too
    (folder / "zenoh.json5").write_text(json.dumps({"transport": {"unicast": unicast}}))
    path = folder / "plant.yaml"
    path.write_text(json.dumps(file))
    return path


@contextmanager
def slow_link(mbit: float) -> Iterator[tuple[str, list[str]]]:
    """Yields the address of the gateway, and what a command behind the link begins with."""
    if not mbit:
        yield "127.0.0.1", []
        return
    for command in (
        f"ip netns add {NAME}",
        f"ip link add {NAME} type veth peer name {NAME} netns {NAME}",
        f"ip address add {HOST}/24 dev {NAME}",
        f"ip link set {NAME} up",
        f"ip -n {NAME} address add {GUEST}/24 dev {NAME}",
        f"ip -n {NAME} link set {NAME} up",
        f"tc qdisc add dev {NAME} root tbf rate {mbit}mbit burst 8kb latency 50ms",
        f"tc -n {NAME} qdisc add dev {NAME} root tbf rate {mbit}mbit burst 8kb latency 50ms",
    ):
        subprocess.run(command.split(), check=True)
    try:
        yield HOST, ["ip", "netns", "exec", NAME]
    finally:
        subprocess.run(["ip", "link", "delete", NAME], check=True)
        subprocess.run(["ip", "netns", "delete", NAME], check=True)


@contextmanager
def process(
    command: Sequence[str], cwd: Path = ROOT, **how: Any
) -> Iterator["subprocess.Popen[str]"]:
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=cwd, **how) as started:
        try:
            yield started
        finally:
            started.kill()


def connected(endpoint: str, *, two: bool = False, packed: bool = False) -> zenoh.Session:
    """Opens a session that knows the gateway. `two`: with a link for urgent messages."""
    config = configure(ZenohConfig(mode=ZenohMode.CLIENT, connect=(endpoint,)))
    config.insert_json5("connect/timeout_ms", "30000")  # the gateway starts meanwhile
    config.insert_json5("transport/unicast/compression/enabled", json.dumps(packed))
    if two:
        config.insert_json5("transport/unicast/max_links", "2")
        both = [f"{endpoint}?prio=1-3", f"{endpoint}?prio=4-7"]
        group = [{"strategy": "allOf", "locators": both}]
        config.insert_json5("connect/endpoints", json.dumps(group))
    session = zenoh.open(config)
    with session.declare_querier("plant/**") as querier:
        while not querier.matching_status.matching:  # type: ignore[attr-defined]
            time.sleep(0.01)
    return session


def follow(endpoint: str, seconds: float, *, history: bool, two: bool, packed: bool) -> None:
    """Prints the delays by kind, in seconds, and the samples of the past that arrived."""
    late: dict[str, list[float]] = {kind: [] for kind in KINDS.values()}

    def arrived(sample: zenoh.Sample) -> None:
        now, document = time.time(), json.loads(sample.payload.to_bytes())
        kind = next(kind for end, kind in KINDS.items() if str(sample.key_expr).endswith(end))
        if at := document["since" if kind == "alarm" else "time"]:
            late[kind].append(now - datetime.fromisoformat(at).timestamp())

    with connected(endpoint, two=two, packed=packed) as session:
        for key in ("plant/@gateway/demo/alarms/mixer/door", "plant/@gateway/demo/writes"):
            session.declare_subscriber(key, arrived)
        session.declare_subscriber("plant/mixer/door", arrived)
        time.sleep(min(1.0, seconds))
        for times in late.values():
            times.clear()
        print("ready", flush=True)
        until, past, after = time.monotonic() + seconds, 0, ""
        while time.monotonic() < until:
            if not history:
                time.sleep(0.1)
                continue
            for reply in session.get(
                f"plant/mixer/*?_time=[..];page=100000{after}",
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=60.0,
            ):
                if (sample := reply.ok) is None:
                    continue
                past += 1
                if str(sample.key_expr).endswith("/page"):
                    after = f";after={json.loads(sample.payload.to_bytes())['next']}"
        print(json.dumps({"late": late, "past": past}), flush=True)


def toggle(endpoint: str) -> None:
    with connected(endpoint) as session:
        value = True
        while True:
            for _ in session.get("plant/mixer/door/@set", payload=json.dumps(value)):
                pass
            value = not value
            time.sleep(EVERY)


def measure(
    endpoints: dict[str, str], behind: list[str], seconds: float, *, history: bool, how: list[str]
) -> None:
    own = [sys.executable, "-m", "benchmarks.slow_link"]
    what = "beside an answer" if history else "alone"
    command = [*behind, *own, "--follow", endpoints["slow"], "--seconds", str(seconds)]
    command += [*how, *(["--past"] if history else [])]
    with process(command) as client, process([*own, "--toggle", endpoints["fast"]]):
        assert client.stdout is not None
        client.stdout.readline()
        found = json.loads(client.stdout.readline())
    for kind, late in found["late"].items():
        late.sort()
        shown = ""
        if late:
            p50, p99 = late[len(late) // 2], late[int(len(late) * 0.99)]
            shown = f"p50 {p50 * 1e3:.0f} ms, p99 {p99 * 1e3:.0f} ms, worst {late[-1] * 1e3:.0f} ms"
        print(f"{kind} {what}: {len(late)} arrived, {shown}")
    print(f"samples of the past {what}: {found['past']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1_200_000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--mbit", type=float, default=1.0)
    parser.add_argument("--gateway", type=Path, default=ROOT, help="a checkout")
    parser.add_argument("--two", action="store_true")
    parser.add_argument("--packed", action="store_true")
    parser.add_argument("--follow")
    parser.add_argument("--past", action="store_true")
    parser.add_argument("--toggle")
    given = parser.parse_args()
    if given.follow:
        follow(given.follow, given.seconds, history=given.past, two=given.two, packed=given.packed)
        return
    if given.toggle:
        toggle(given.toggle)
        return
    with tempfile.TemporaryDirectory() as name, slow_link(given.mbit) as (address, behind):
        port = free_port()
        endpoints = {"slow": f"tcp/{address}:{port}", "fast": f"tcp/127.0.0.1:{port}"}
        path = plant_file(Path(name), [*dict.fromkeys(endpoints.values())])
        past = [tag for tag in load(path).devices[0].tags if tag.publishing.history]
        write(Path(name) / "history.db", past, given.samples)
        run = [sys.executable, "-m", "gateway", "run", str(path)]
        with process(run, given.gateway, stderr=subprocess.DEVNULL):
            for history in (False, True) if given.mbit else (True,):
                how = [f"--{name}" for name in ("two", "packed") if vars(given)[name]]
                measure(endpoints, behind, given.seconds, history=history, how=how)


if __name__ == "__main__":
    main()
