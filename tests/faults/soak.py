"""A gateway at full load for a long time: what it holds in memory, and what it keeps open.

    python -m tests.faults.soak --minutes 30

Four serial lines with more tags than they can carry and one Modbus TCP device, all served by
`plc-gateway simulate` in a process of its own; a Zenoh client that takes every sample, asks for
values and writes. Every ten seconds the gateway's memory and file descriptors are noted. Ends
with exit code 1 when memory grows by more than a hundredth after the warm-up, or any file
descriptor stays open.
"""

import argparse
import json
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from tests.e2e.processes import Program, free_port, gateway, started, write_config
from tests.zenoh_peer import free_endpoint

EVERY = 10.0  # seconds between two looks
MOST_GROWTH = 0.01
WARM_UP = 1 / 3  # of the whole time


class Look(NamedTuple):
    """The gateway process at one moment; memory in kB."""

    seconds: float
    memory: int
    descriptors: int
    threads: int
    samples: int
    writes: int


def plant() -> dict[str, Any]:
    """Four wires that are never quiet and one network device."""

    def registers(area: str, **more: Any) -> dict[str, Any]:
        tags = {f"v{n}": {"address": f"{area}{n * 3}", **more} for n in range(40)}
        return tags | {f"w{n}": {"address": f"{area}{500 + n}", "write": True} for n in range(4)}

    def line(protocol: str, area: str, count: int, wire: dict[str, Any]) -> dict[str, Any]:
        devices = {
            f"{protocol}-{n}": {"protocol": protocol, "station": n, "tags": registers(area)}
            for n in range(1, count + 1)
        }
        return {"port": f"tcp://127.0.0.1:{free_port()}", **wire, "devices": devices}

    return {
        "vigor": line("vigor", "D", 8, {"baudrate": 19200, "format": "7E1"}),
        "link": line("computer-link", "D", 4, {"baudrate": 19200, "format": "7E1"}),
        "rtu": line("modbus-rtu", "holding:", 8, {"baudrate": 115200, "format": "8E1"}),
        "ascii": line("modbus-ascii", "holding:", 4, {"baudrate": 19200, "format": "7E1"}),
        "tcp": line("modbus-tcp", "holding:", 1, {}),
    }


class Customers:
    """A Zenoh client that takes everything, asks, and writes all the time."""

    def __init__(self, endpoint: str, tags: list[str]) -> None:
        settings = zenoh.Config()
        settings.insert_json5("mode", '"client"')
        settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
        settings.insert_json5("scouting/multicast/enabled", "false")
        self.samples = self.writes = self.failures = 0
        self._session = zenoh.open(settings)
        self._subscriber = self._session.declare_subscriber("plant/**", self._heard)
        self._tags = tags
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work)
        self._worker.start()

    def _heard(self, _sample: zenoh.Sample) -> None:
        self.samples += 1

    def _work(self) -> None:
        number = 0
        while not self._stop.is_set():
            tag = self._tags[number % len(self._tags)]
            number += 1
            for reply in self._session.get(f"plant/{tag}/@set", payload=b"%d" % (number % 1000)):
                self.writes += 1
                self.failures += reply.ok is None
            list(self._session.get(f"plant/{tag}"))

    def close(self) -> None:
        self._stop.set()
        self._worker.join()
        self._session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def look(pid: int, seconds: float, customers: Customers) -> Look:
    process = Path("/proc") / str(pid)
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    return Look(
        round(seconds, 1),
        int(status["VmRSS"].split()[0]),
        len(list((process / "fd").iterdir())),
        int(status["Threads"]),
        customers.samples,
        customers.writes,
    )


def looks(service: Program, customers: Customers, minutes: float) -> Iterator[Look]:
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < minutes * 60:
        time.sleep(min(EVERY, minutes * 60 - passed))
        if not service.running:
            raise AssertionError("the gateway ended by itself")
        yield look(service.pid, time.monotonic() - begun, customers)


def verdict(seen: list[Look]) -> dict[str, Any]:
    """Medians of the minutes after the warm-up and of the last ones: single looks jump."""
    first = [one for one in seen if one.seconds >= seen[-1].seconds * WARM_UP]
    part = max(1, len(first) // 4)
    before = statistics.median(one.memory for one in first[:part])
    after = statistics.median(one.memory for one in first[-part:])
    seconds = seen[-1].seconds - seen[0].seconds
    return {
        "minutes": round(seen[-1].seconds / 60, 1),
        "memory_kB": [before, after],
        "growth_percent": round(100 * (after / before - 1), 3),
        "descriptors": [first[0].descriptors, seen[-1].descriptors],
        "most_descriptors": max(one.descriptors for one in first),
        "threads": [first[0].threads, seen[-1].threads],
        "samples_per_second": round((seen[-1].samples - seen[0].samples) / seconds, 1),
        "writes_per_second": round((seen[-1].writes - seen[0].writes) / seconds, 1),
    }


def soak(folder: Path, minutes: float) -> dict[str, Any]:
    endpoint, lines = free_endpoint(), plant()
    config = write_config(
        folder / "config.yaml",
        endpoint,
        lines,
        defaults={"every": "50ms", "publish": "always", "history": True},
        history={"path": "history.db", "max_size": "20MB"},
    )
    tags = [
        f"{device}/{tag}"
        for line in lines.values()
        for device, settings in line["devices"].items()
        for tag in settings["tags"]
        if tag.startswith("w")
    ]
    with gateway("simulate", config) as plcs:
        plcs.says("Ctrl-C")
        with started(config) as service:
            customers = Customers(endpoint, tags)
            seen = []
            with (folder / "looks.jsonl").open("w") as notes:
                for one in looks(service, customers, minutes):
                    seen.append(one)
                    notes.write(json.dumps(one._asdict()) + "\n")
                    notes.flush()
            customers.close()
            code = service.end(signal.SIGTERM)
        plcs.end()
    result = verdict(seen) | {"exit_code": code, "failed_writes": customers.failures}
    (folder / "result.json").write_text(json.dumps(result, indent=2))
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--folder", type=Path)
    chosen = parser.parse_args()
    folder = chosen.folder or Path(tempfile.mkdtemp(prefix="soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    result = soak(folder, chosen.minutes)
    print(json.dumps(result, indent=2))
    before, after = result["descriptors"]
    return int(result["growth_percent"] > 100 * MOST_GROWTH or after > before)


if __name__ == "__main__":
    sys.exit(main())
