"""Reloads under load: `python -m benchmarks.reload --reloads 200`.

A gateway polls 64 lines of two simulated stations each, and a client writes all the time. The file
of half of the lines changes at random, one thing at a time: intervals, tags, devices, the speed of
a line. Each change is reloaded with SIGHUP. It prints the time of the reloads, the memory, and what
the other half missed: it must be nothing. At the end it compares the keys and the tokens on
Zenoh with the file.
"""

import argparse
import json
import os
import random
import signal
import statistics
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e.processes import gateway, listens, until
from tests.zenoh_peer import free_endpoint

OWN = "reload/@gateway/demo"


def plant(endpoint: str, lines: int) -> dict[str, Any]:
    def device(station: int) -> dict[str, Any]:
        tags: dict[str, Any] = {f"t{n}": {"address": f"D{n * 3}"} for n in range(20)}
        tags["set"] = {"address": "D200", "write": True}
        return {"protocol": "vigor", "station": station, "tags": tags}

    return {
        "gateway": {"name": "demo"},
        "zenoh": {"prefix": "reload", "listen": [endpoint]},
        "defaults": {"every": "500ms"},
        "lines": {
            f"line-{n}": {
                "port": "simulator",
                "baudrate": 19200,
                "devices": {f"plc-{n}-{station}": device(station) for station in (1, 2)},
            }
            for n in range(lines)
        },
    }


def change(data: dict[str, Any], chance: random.Random) -> None:
    """Changes one thing of one of the first lines."""
    n = chance.randrange(len(data["lines"]) // 2)
    line = data["lines"][f"line-{n}"]
    device = line["devices"][f"plc-{n}-1"]
    match chance.randrange(5):
        case 0:
            device["defaults"] = {"every": f"{chance.randrange(2, 20) * 100}ms"}
        case 1:
            device["tags"]["more"] = {"address": f"D{chance.randrange(300, 400)}"}
        case 2:
            device["tags"].pop("more", None)
        case 3:
            guest = {"protocol": "vigor", "station": 3, "tags": {"level": {"address": "D1"}}}
            if line["devices"].pop(f"guest-{n}", None) is None:
                line["devices"][f"guest-{n}"] = guest
        case _:
            line["baudrate"] = chance.choice((9600, 19200, 38400))


class Client:
    """Reads documents, and writes without a pause to the lines that do not change."""

    def __init__(self, endpoint: str, lines: int) -> None:
        self._lines = lines
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        self.session = zenoh.open(config)
        self.writes = self.failed = 0
        self._ending = threading.Event()
        self._writer = threading.Thread(target=self._write)

    def begin(self) -> None:
        self._writer.start()

    def close(self) -> None:
        self._ending.set()
        self._writer.join()
        self.session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it

    def documents(self, path: str) -> dict[str, Any]:
        replies = self.session.get(f"{OWN}/{path}", timeout=10.0)
        return {str(r.ok.key_expr): json.loads(r.ok.payload.to_bytes()) for r in replies if r.ok}

    def keys(self, expression: str) -> set[str]:
        replies = self.session.get(expression, timeout=10.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok}

    def tokens(self) -> set[str]:
        replies = self.session.liveliness().get(f"{OWN}/alive/*", timeout=10.0)
        return {str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok}

    def is_served(self) -> bool:
        time.sleep(0.5)
        status = self.documents("status").get(f"{OWN}/status", {"devices": {}})
        return [*status["devices"].values()].count("up") == 2 * self._lines

    def others(self) -> list[dict[str, Any]]:
        """The documents of the devices on lines that do not change."""
        return [
            document
            for key, document in self.documents("devices/*").items()
            if int(key.rpartition("/")[2].split("-")[1]) >= self._lines // 2
        ]

    def missed(self) -> int:
        return sum(document["overruns"] for document in self.others())

    def reloads(self) -> int:
        return int(self.documents("reload")[f"{OWN}/reload"]["reloads"])

    def _write(self) -> None:
        chance = random.Random(2)
        while not self._ending.is_set():
            key = f"reload/plc-{chance.randrange(self._lines // 2, self._lines)}-1/set/@set"
            replies = list(self.session.get(key, payload=b"7", timeout=10.0))
            self.writes += 1
            self.failed += not (replies and replies[0].ok)
            self._ending.wait(0.02)


def memory(pid: int) -> float:
    """Returns megabytes."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description="reloads under load")
    parser.add_argument("--reloads", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--lines", type=int, default=64)
    given = parser.parse_args()
    in_round = given.reloads // given.rounds
    chance, endpoint = random.Random(1), free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        file, data = Path(folder) / "c.yaml", plant(endpoint, given.lines)
        file.write_text(json.dumps(data))
        with gateway("run", file, "--log-level", "error") as program:
            until(lambda: listens(int(endpoint.rpartition(":")[2])), "the gateway listens")
            client = Client(endpoint, given.lines)
            until(client.is_served, "every line is open")
            client.begin()
            missed = client.missed()
            time.sleep(5.0)
            took = []
            for n in range(1, in_round * given.rounds + 1):
                if n % in_round:
                    change(data, chance)
                else:
                    data = plant(endpoint, given.lines)
                file.write_text(json.dumps(data))
                begun = time.monotonic()
                os.kill(program.pid, signal.SIGHUP)
                while client.reloads() < n:
                    time.sleep(0.02)
                took.append(time.monotonic() - begun)
                if n % in_round == 0:
                    print(f"{n:4} reloads: {memory(program.pid):.0f} MB", flush=True)
            time.sleep(3.0)
            report(client, data, took, missed)
            client.close()
            program.end()


def report(client: Client, data: dict[str, Any], took: list[float], missed: int) -> None:
    print(f"a reload took {statistics.median(took):.2f} s, at most {max(took):.2f} s")
    print(f"{client.writes} writes to the other lines, {client.failed} failed")
    others = client.others()
    worst = max(r["worst_age"] or 0.0 for one in others for r in one["requests"])
    failures = sum(sum(document["failures"].values()) for document in others)
    missed = client.missed() - missed
    print(f"the other lines: {missed} polls missed, longest gap {worst:.2f} s, {failures} failures")
    devices = {
        name: one for line in data["lines"].values() for name, one in line["devices"].items()
    }
    keys = {f"reload/{name}/{tag}" for name, one in devices.items() for tag in one["tags"]}
    print(f"keys as in the file: {client.keys('reload/*/*') == keys}")
    print(f"tokens as in the file: {client.tokens() == set(devices)}")
    claims = client.documents("claim/*").values()
    print(f"claim as in the file: {[set(one['devices']) for one in claims] == [set(devices)]}")


if __name__ == "__main__":
    main()
