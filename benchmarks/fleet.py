"""Many gateways behind three routers, seen by `plc-gateway fleet`: `python -m benchmarks.fleet`.

Each gateway here is a Zenoh session of its own, with a token and a report as gateways have it, some
hundred in one process. The files of all are in a folder; a few gateways run another file, and one
process of gateways is killed. The program prints how long the command takes, and whether it names
exactly those.
"""

import argparse
import asyncio
import json
import sys
import tempfile
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import zenoh

from gateway.config import load
from tests.zenoh_peer import ZenohPeer, free_endpoint

PREFIX, EVERY_OTHER = "works", 97  # one gateway of so many runs another file
FILE = """\
gateway: {{name: g{number}}}
zenoh: {{prefix: works/hall-{hall}, mode: client, connect: [tcp/127.0.0.1:7447]}}
lines:
  north:
    port: /dev/ttyUSB0
    devices:
      mixer:
        protocol: vigor
        station: {station}
        tags: {{speed: {{address: D{number}}}, level: {{address: D9000}}}}
"""


def file_of(number: int) -> str:
    return FILE.format(number=number, hall=number % 20, station=number % 31 + 1)


def report(number: int, digest: str) -> bytes:
    """As a gateway has it."""
    document = {
        "contract": 1,
        "name": f"g{number}",
        "version": "1.0.0",
        "time": time.strftime("%Y-%m-%dT%H:%M:%S.000000Z", time.gmtime()),
        "up": 60.0,
        "tags": 300,
        "not_real": False,
        "lines": 4,
        "lines_down": 0,
        "devices": {"up": 12},
        "load": 0.42,
        "faults": {},
        "fault": "",
        "warnings": 0,
        "digest": digest,
        "revision": "0123456789ab",
        "loaded": "2026-11-24T12:00:00.000000Z",
        "refused": None,
        "refused_why": "",
        "certificate_days": 300.0,
        "disk_days": None,
        "stand": None,
    }
    return json.dumps(document).encode()


def serve(endpoints: list[str], digests: dict[str, str]) -> None:
    """Is so many gateways, in this process, until its input ends."""
    sessions = []
    for number, digest in ((int(number), digest) for number, digest in digests.items()):
        setup = zenoh.Config()
        setup.insert_json5("mode", '"client"')
        setup.insert_json5("connect/endpoints", json.dumps([endpoints[number % len(endpoints)]]))
        setup.insert_json5("scouting/multicast/enabled", "false")
        session = zenoh.open(setup)
        own = f"{PREFIX}/hall-{number % 20}/@gateway/g{number}"

        def answer(
            query: zenoh.Query, key: str = f"{own}/report", what: Any = (number, digest)
        ) -> None:
            query.reply(key, report(*what))

        session.declare_queryable(f"{own}/**", answer)
        sessions.append((session, session.liveliness().declare_token(own)))
    print("ready", flush=True)
    sys.stdin.read()


async def seen(endpoint: str, folder: Path) -> tuple[float, float, list[dict[str, Any]]]:
    """Runs the command. Returns its seconds without and with the folder, and its rows."""
    took = []
    for more in ((), ("--folder", str(folder))):
        began = time.monotonic()
        command = ["-m", "gateway", "fleet", PREFIX, "--connect", endpoint, "--json", *more]
        process = await asyncio.create_subprocess_exec(
            sys.executable, *command, stdout=asyncio.subprocess.PIPE
        )
        out, _ = await process.communicate()
        took.append(time.monotonic() - began)
    return took[0], took[1], [json.loads(line) for line in out.splitlines()]


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(**json.loads(given.serve))
        return
    count, processes = given.gateways, given.processes
    ends = [free_endpoint() for _ in range(3)]
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for number in range(count):
            (folder / f"g{number}.yaml").write_text(file_of(number))
        digests = {number: load(folder / f"g{number}.yaml").digest for number in range(count)}
        others = set(range(0, count, EVERY_OTHER))
        digests |= dict.fromkeys(others, "another")
        for number, end in enumerate(ends):
            await stack.enter_async_context(ZenohPeer("router", [end], ends[:number]))
        running = []
        for first in range(processes):
            own = {str(number): digests[number] for number in range(first, count, processes)}
            served = json.dumps({"endpoints": ends, "digests": own})
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "benchmarks.fleet", "--serve", served),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
            )
            running.append(process)
        for process in running:
            assert process.stdout is not None
            await process.stdout.readline()
        quick, whole, rows = await seen(ends[2], folder)
        drift = {row["gateway"] for row in rows if row["drift"]}
        wanted = {f"{PREFIX}/hall-{number % 20}/g{number}" for number in others}
        told = sum(row["state"] != "missing" for row in rows)
        print(f"{told} of {count} gateways in {quick:.1f} s, with their files in {whole:.1f} s")
        print(f"files that differ: {len(drift)} named, {len(drift ^ wanted)} of them wrong")
        running[0].kill()
        await running[0].wait()
        gone = len(range(0, count, processes))
        quick, whole, rows = await seen(ends[2], folder)
        missing = sum(row["state"] == "missing" for row in rows)
        print(f"{gone} gateways killed: {missing} missing, in {quick:.1f} s")
        for process in running[1:]:
            process.kill()
            await process.wait()


if __name__ == "__main__":
    asyncio.run(main())
