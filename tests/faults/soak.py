"""A gateway at full load for a long time: what it holds in memory, and what it keeps open.

    python -m tests.faults.soak --minutes 30

Four serial lines with more tags than they can carry and one Modbus TCP device, all served by
`plc-gateway simulate` in a process of its own, and a scale that streams on a pty; every sample goes
to history, whose file is full after a few minutes; a Zenoh client that takes every sample, asks for
values, history, and writes. Every ten seconds the gateway's memory, file descriptors, threads and
files are noted. Says at the end what is wrong, if anything is, and ends with exit code 1 then:
memory that grows by more than a hundredth after the warm-up, a file descriptor or thread that
stays, a file beyond its limit, a write that failed, a sample that history lost.
"""

import argparse
import json
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from tests.e2e.processes import Program, free_port, gateway, started, write_config
from tests.e2e.test_frames import STABLE, ByteDevice
from tests.zenoh_peer import free_endpoint

EVERY = 10.0  # seconds between two looks
MOST_GROWTH = 0.01
WARM_UP = 1 / 2  # of the whole time: memory still grows by steps in the first ten minutes
MOST_HISTORY = 10_000_000  # bytes
STOOD_STILL = {"unclear", "busy"}  # what a write gets when the machine itself stops for seconds


class Look(NamedTuple):
    """The gateway process at one moment; memory in kB: its own, and with the code it has used."""

    seconds: float
    memory: int
    resident: int
    descriptors: int
    threads: int
    files: int  # bytes of history
    samples: int
    writes: int


def plant() -> dict[str, Any]:
    """Four wires that are never quiet and one network device."""

    def registers(area: str, **more: Any) -> dict[str, Any]:
        tags = {f"v{n}": {"address": f"{area}{n * 3}", **more} for n in range(40)}
        return tags | {f"w{n}": {"address": f"{area}{500 + n}", "write": True} for n in range(4)}

    def line(protocol: str, area: str, count: int, wire: dict[str, Any]) -> dict[str, Any]:
        devices = {
            f"{protocol}-{n}": {
                "protocol": protocol,
                "station": n,
                "reply_timeout": "5s",  # a write must not fail because the machine is slow
                "tags": registers(area),
            }
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


def scale(port: str) -> dict[str, Any]:
    """A device without a protocol that streams its weight."""
    weighing = {
        "match": r"(?P<state>ST|US),(?P<weight>[+-][0-9.]{8}) *g",
        "fields": {"weight": {"type": "decimal"}, "state": {"type": "text"}},
        "stale_after": "2s",
    }
    device = {
        "protocol": "frames",
        "framing": {"ending": "CR LF", "max_length": 32},
        "listen": {"weighing": weighing},
        "tags": {"weight": {"address": "weight", "unit": "g"}, "state": {"address": "state"}},
    }
    return {"port": port, "baudrate": 9600, "format": "8N1", "devices": {"scale": device}}


class Customers:
    """A Zenoh client that takes everything, asks, and writes all the time."""

    def __init__(self, endpoint: str, tags: list[str]) -> None:
        settings = zenoh.Config()
        settings.insert_json5("mode", '"client"')
        settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
        settings.insert_json5("scouting/multicast/enabled", "false")
        self.samples = self.writes = self.weights = self.remembered = 0
        self.failures: Counter[str] = Counter()
        self._session = zenoh.open(settings)
        self._subscriber = self._session.declare_subscriber("plant/**", self._heard)
        self._tags = tags
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work)
        self._worker.start()

    def _heard(self, sample: zenoh.Sample) -> None:
        self.samples += 1
        self.weights += str(sample.key_expr) == "plant/scale/weight"

    def _work(self) -> None:
        number = 0
        while not self._stop.is_set():
            tag = self._tags[number % len(self._tags)]
            number += 1
            for reply in self._session.get(f"plant/{tag}/@set", payload=b"%d" % (number % 1000)):
                self.writes += 1
                if reply.err is not None:
                    self.failures[json.loads(bytes(reply.err.payload))["error"]] += 1
            list(self._session.get(f"plant/{tag}"))
            if number % 20 == 0:
                found = self._session.get(f"plant/{tag}?_time=[now(-10s)..]")
                self.remembered += sum(reply.ok is not None for reply in found)

    def history(self) -> dict[str, Any]:
        """Returns the history document of the gateway."""
        [reply] = self._session.get("plant/@gateway/demo/history")
        assert reply.ok is not None
        document: dict[str, Any] = json.loads(bytes(reply.ok.payload))
        return document

    def close(self) -> None:
        self._stop.set()
        self._worker.join()
        self._session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def look(pid: int, seconds: float, customers: Customers, folder: Path) -> Look:
    process = Path("/proc") / str(pid)
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    return Look(
        round(seconds, 1),
        int(status["RssAnon"].split()[0]),
        int(status["VmRSS"].split()[0]),
        len(list((process / "fd").iterdir())),
        int(status["Threads"]),
        sum(path.stat().st_size for path in folder.glob("history.db*")),
        customers.samples,
        customers.writes,
    )


def looks(service: Program, customers: Customers, folder: Path, minutes: float) -> Iterator[Look]:
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < minutes * 60:
        time.sleep(min(EVERY, minutes * 60 - passed))
        if not service.running:
            raise AssertionError("the gateway ended by itself")
        yield look(service.pid, time.monotonic() - begun, customers, folder)


def measured(seen: list[Look]) -> dict[str, Any]:
    """Medians of the minutes after the warm-up and of the last ones: single looks jump."""
    first = [one for one in seen if one.seconds >= seen[-1].seconds * WARM_UP]
    part = max(1, len(first) // 4)

    def medians(of: str) -> list[float]:
        return [
            statistics.median(getattr(one, of) for one in some)
            for some in (first[:part], first[-part:])
        ]

    before, after = medians("memory")
    seconds = seen[-1].seconds - seen[0].seconds
    return {
        "minutes": round(seen[-1].seconds / 60, 1),
        "memory_kB": [before, after],
        "resident_kB": medians("resident"),
        "growth_percent": round(100 * (after / before - 1), 3),
        "descriptors": medians("descriptors"),
        "most_descriptors": max(one.descriptors for one in first),
        "threads": medians("threads"),
        "most_file_bytes": max(one.files for one in seen),
        "samples_per_second": round((seen[-1].samples - seen[0].samples) / seconds, 1),
        "writes_per_second": round((seen[-1].writes - seen[0].writes) / seconds, 2),
    }


def complaints(result: dict[str, Any]) -> list[str]:
    """Returns the names of the broken limits."""

    def grew(what: str) -> bool:
        before, after = result[what]
        return bool(after > before)

    wrong = {
        "memory grew": result["growth_percent"] > 100 * MOST_GROWTH,
        "file descriptors stayed open": grew("descriptors"),
        "threads stayed": grew("threads"),
        "the history file is beyond its limit": result["most_file_bytes"] > MOST_HISTORY,
        "history lost samples": result["history"]["lost"] or result["history"]["state"] != "ok",
        "history was not answered": not result["remembered"],
        "the scale was not heard": not result["weights"],
        "writes failed": result["failed_writes"].keys() - STOOD_STILL,
        "nothing was written": not result["writes_per_second"],
        "it did not end well": result["exit_code"] != 0,
    }
    return [what for what, is_so in wrong.items() if is_so]


def soak(folder: Path, minutes: float) -> dict[str, Any]:
    endpoint, lines = free_endpoint(), plant()
    sections = {
        "defaults": {"every": "50ms", "publish": "always", "history": True},
        "history": {"path": "history.db", "max_size": f"{MOST_HISTORY // 10**6}MB"},
    }
    tags = [
        f"{device}/{tag}"
        for line in lines.values()
        for device, settings in line["devices"].items()
        for tag in settings["tags"]
        if tag.startswith("w")
    ]
    polled = write_config(folder / "simulate.yaml", endpoint, lines, **sections)
    with gateway("simulate", polled) as plcs, ByteDevice(streams=STABLE) as streaming:
        plcs.says("Ctrl-C")
        lines["bench"] = scale(streaming.port)
        config = write_config(folder / "config.yaml", endpoint, lines, **sections)
        with started(config) as service:
            customers = Customers(endpoint, tags)
            seen = []
            with (folder / "looks.jsonl").open("w") as notes:
                for one in looks(service, customers, folder, minutes):
                    seen.append(one)
                    notes.write(json.dumps(one._asdict()) + "\n")
                    notes.flush()
            history = customers.history()
            customers.close()
            code = service.end(signal.SIGTERM)
        plcs.end()
    result = measured(seen) | {
        "weights": customers.weights,
        "remembered": customers.remembered,
        "history": history,
        "failed_writes": customers.failures,
        "exit_code": code,
    }
    result["wrong"] = complaints(result)
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
    print("; ".join(result["wrong"]) or "all is well")
    return 1 if result["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
