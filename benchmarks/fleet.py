"""Many gateways behind three routers, as `plc-gateway fleet` sees and changes them:
`python -m benchmarks.fleet`.

Each gateway here is a Zenoh session of its own with a configuration file, a report and the part
`remote` of the program, some hundred in one process; it has no lines, and its device is silent if
the file gives it station 31. The program prints how long `fleet` takes, and whether it names
exactly the files that differ; how long `fleet apply` takes for all; whether a file that is never
confirmed goes back in its time everywhere; what a rollout says when a router fails in the middle of
it, and what is true when the router is back. At the end one process of gateways is killed. The exit
code is 1 if a gateway was left out, a name was wrong or a file stayed: not for the times.
"""

import argparse
import asyncio
import json
import logging
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import structlog
import zenoh

from gateway.cli.fleet.place import Place
from gateway.config import Config, load
from gateway.engine.forecast import LineForecast
from gateway.errors import GatewayError
from gateway.parts.remote.part import RemotePart
from gateway.parts.remote.settings import RemoteSection
from gateway.plant.expected import polls_of
from gateway.tags.timestamps import rfc3339
from tests.zenoh_peer import ZenohPeer, free_endpoint

WITHIN = 10  # seconds until a file of the parted rollout goes back
PREFIX, EVERY_OTHER = "works", 97  # one gateway of so many runs another file
BAD_STATION = 31
FILE = """\
gateway: {{name: g{number}}}
writers: {{file: writers.txt}}
remote: {{writers: [ana]}}
zenoh: {{prefix: works/hall-{hall}, mode: client, connect: [tcp/127.0.0.1:7447]}}
lines:
  north:
    port: /dev/ttyUSB0
    devices:
      mixer:
        protocol: vigor
        station: {station}
        tags: {{speed: {{address: D{number}}}, level: {{address: D{level}}}}}
"""


def file_of(number: int, level: int, station: int | None = None) -> str:
    station = station or number % (BAD_STATION - 1) + 1
    return FILE.format(number=number, hall=number % 20, station=station, level=level)


def key_of(number: int) -> str:
    return f"{PREFIX}/hall-{number % 20}/@gateway/g{number}"


class Gateway:
    """A gateway without lines: its file, its report, and the part `remote`."""

    def __init__(self, path: Path, session: zenoh.Session, number: int) -> None:
        self.path, self._number, self._session = path, number, session
        self.current = load(path)
        self._loaded = self.wall()
        self._loop = asyncio.get_running_loop()
        core: Any = self
        settings = self.current.part(RemoteSection)
        assert settings is not None
        self.part = RemotePart(core, settings, self)
        self.plant = self.others = self
        self._served = session.declare_queryable(f"{key_of(number)}/**", self._query)
        self._token = session.liveliness().declare_token(key_of(number))

    # -- as the part needs it --

    @staticmethod
    def wall() -> int:
        return time.time_ns()

    @staticmethod
    def forecasts(config: Config) -> Sequence[LineForecast]:
        return polls_of(config)

    def audit(self, at: int, event: str) -> None:
        pass

    async def reload(self) -> Sequence[str]:
        self.current = load(self.path)
        self._loaded = self.wall()
        return ()

    # -- its documents --

    def _query(self, query: zenoh.Query) -> None:
        """Called by a thread of Zenoh."""
        if query.payload is not None:
            order = self._order(query.payload.to_bytes(), query)
            asyncio.run_coroutine_threadsafe(order, self._loop)
            return
        documents = {
            "report": self.report,
            "status": lambda: {"devices": self._devices()},
            "remote/file": self.part.document,
        }
        for path, document in documents.items():
            key = zenoh.KeyExpr(f"{key_of(self._number)}/{path}")
            if query.key_expr.intersects(key):
                query.reply(key, json.dumps(document()))

    async def _order(self, data: bytes, query: zenoh.Query) -> None:
        key = f"{key_of(self._number)}/remote/file"
        try:
            query.reply(key, await self.part.order("file", data, "ana"))
        except GatewayError as error:
            query.reply_err(json.dumps({"error": "refused", "reason": str(error)}))
        query.drop()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it

    def _devices(self) -> dict[str, str]:
        [device] = self.current.devices
        return {"mixer": "silent" if device.driver.station == BAD_STATION else "up"}

    def report(self) -> Mapping[str, object]:
        silent = self._devices()["mixer"] == "silent"
        return {
            "contract": 1,
            "name": f"g{self._number}",
            "version": "1.0.0",
            "time": rfc3339(self.wall()),
            "up": 60.0,
            "tags": 300,
            "not_real": False,
            "lines": 4,
            "lines_down": 0,
            "devices": {"silent" if silent else "up": 1},
            "load": 0.42,
            "faults": {"device-silent": 1} if silent else {},
            "fault": "mixer is silent: no reply" if silent else "",
            "warnings": 0,
            "digest": self.current.digest,
            "revision": "0123456789ab",
            "loaded": rfc3339(self._loaded),
            "refused": None,
            "refused_why": "",
            "certificate_days": 300.0,
            "disk_days": None,
            "group": None,
            "stand": None,
        }


async def serve(endpoints: list[str], folder: str, numbers: list[int]) -> None:
    """Is so many gateways, in this process, until its input ends."""
    # A full pipe would block them all.
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    running = []
    for number in numbers:
        setup = zenoh.Config()
        setup.insert_json5("mode", '"client"')
        setup.insert_json5("connect/endpoints", json.dumps([endpoints[number % len(endpoints)]]))
        setup.insert_json5("scouting/multicast/enabled", "false")
        path = Path(folder) / f"{number}" / "plant.yaml"
        path.parent.mkdir()
        level = 9001 if number % EVERY_OTHER == 0 else 9000
        path.write_text(file_of(number, level))
        secret = path.with_name("writers.txt")
        secret.write_text(f"ana:{'0' * 32}\n")
        secret.chmod(0o600)
        gateway = Gateway(path, zenoh.open(setup), number)
        gateway.part.activate()
        running.append(asyncio.create_task(gateway.part.run()))
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)


class Bench:
    """The commands, as a person runs them. `wrong`: what is not as it must be."""

    def __init__(self, endpoint: str, folder: Path, count: int, parallel: int) -> None:
        self.endpoint, self.folder, self.count = endpoint, folder, count
        self.parallel = parallel
        self.wrong: list[str] = []

    def judge(self, what: str, found: object, right: object) -> None:
        if found != right:
            self.wrong.append(f"{what}: {found}, and not {right}")

    def files(self, name: str, level: int) -> Path:
        folder = self.folder / name
        folder.mkdir()
        for number in range(self.count):
            (folder / f"g{number}.yaml").write_text(file_of(number, level))
        return folder

    async def fleet(self, *options: object) -> tuple[float, list[dict[str, Any]], str]:
        """Runs a command. Returns its seconds, its rows, and its errors."""
        began = time.monotonic()
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "gateway", "fleet", PREFIX, *map(str, options)),
            *("--connect", self.endpoint, "--json"),
            env={**os.environ, "PLC_GATEWAY_WRITER": f"ana:{'0' * 32}"},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, errors = await process.communicate()
        rows = [json.loads(line) for line in out.splitlines()]
        return time.monotonic() - began, rows, errors.decode()

    async def apply(self, folder: Path, *options: object) -> tuple[float, Counter[str]]:
        pace = ("--wait", "1s", "--look", "1s", "--parallel", self.parallel)
        took, rows, errors = await self.fleet("apply", folder, *pace, *options)
        if not rows:
            print(errors)
        return took, Counter(row["result"] for row in rows)

    async def digests(self) -> dict[str, tuple[str, float]]:
        """Returns what each gateway runs, and since when (s since 1970)."""
        _, rows, _ = await self.fleet()
        return {
            row["gateway"]: (row["digest"], datetime.fromisoformat(row["loaded"]).timestamp())
            for row in rows
            if "digest" in row
        }

    def unconfirmed(self, back: float) -> dict[str, float]:
        """Gives every gateway a bad file, and confirms none. Returns when each goes back."""

        def give(number: int) -> tuple[str, float]:
            text = file_of(number, 9003, BAD_STATION)
            name = key_of(number).replace("/@gateway/", "/")
            order = {"do": "apply", "file": text, "confirm": back}
            one, until = client.of(name), None
            while until is None:
                with suppress(GatewayError):  # no reply in time: it may have loaded the file
                    one.requests.order("remote/file", order)
                with suppress(GatewayError):
                    until = one.status("remote/file")["until"]
            return name, datetime.fromisoformat(str(until)).timestamp()

        place = Place(PREFIX, [self.endpoint], None)
        with place.connected() as client, ThreadPoolExecutor(self.parallel) as pool:
            return dict(pool.map(give, range(self.count)))


async def seen(bench: Bench, folder: Path) -> None:
    quick, _, _ = await bench.fleet()
    whole, rows, _ = await bench.fleet("--folder", folder)
    drift = {row["gateway"] for row in rows if row["drift"]}
    others = range(0, bench.count, EVERY_OTHER)
    wanted = {f"{PREFIX}/hall-{number % 20}/g{number}" for number in others}
    told = sum(row["state"] != "missing" for row in rows)
    bench.judge("gateways that replied", told, bench.count)
    bench.judge("files that differ", drift, wanted)
    print(f"{told} of {bench.count} gateways in {quick:.1f} s, with their files in {whole:.1f} s")
    print(f"files that differ: {len(drift)} named, {len(drift ^ wanted)} of them wrong", flush=True)


async def changed(bench: Bench) -> None:
    folder = bench.files("second", 9002)
    checked, counts = await bench.apply(folder, "--check")
    bench.judge("checked", counts["good"], bench.count)
    print(f"checked: {counts['good']} good, in {checked:.1f} s", flush=True)
    took, counts = await bench.apply(folder)
    bench.judge("a change on all", counts["confirmed"], bench.count)
    print(f"a change on all: {counts['confirmed']} confirmed, in {took:.1f} s", flush=True)
    took, counts = await bench.apply(folder)
    bench.judge("the same again", counts["same"], bench.count)
    print(f"the same again: {counts['same']} the same, in {took:.1f} s", flush=True)


async def back_by_itself(bench: Bench, back: float) -> None:
    before = await bench.digests()
    began = time.monotonic()
    until = await asyncio.to_thread(bench.unconfirmed, back)
    given = time.monotonic() - began
    await asyncio.sleep(max(0.0, max(until.values()) - time.time()))
    while (after := await bench.digests()) and any(
        after[name][0] != before[name][0] for name in until
    ):
        pass
    late = max(after[name][1] - at for name, at in until.items())
    print(
        f"a bad file on all: given in {given:.1f} s, {len(until)} are back, "
        f"the last {late:.1f} s after its time",
        flush=True,
    )


async def parted(bench: Bench, router: ZenohPeer, again: Any) -> None:
    """A router fails while a third of the gateways has a file that is not confirmed."""
    folder, before = bench.files("third", 9004), await bench.digests()
    running = asyncio.create_task(bench.apply(folder, "--within", f"{WITHIN}s", "--look", "3s"))
    while not any(one != before[name] for name, one in (await bench.digests()).items()):
        pass
    await router.kill()
    took, counts = await running
    said = ", ".join(f"{number} {result}" for result, number in sorted(counts.items()))
    print(f"a router fails in a rollout: {said}, in {took:.1f} s", flush=True)
    await again()
    await asyncio.sleep(WITHIN)  # what is not confirmed goes back by then
    while len(after := await bench.digests()) < bench.count:
        pass
    new = sum(after[name][0] != before[name][0] for name in after)
    bench.judge("new files after a partition", new, counts["confirmed"])
    print(f"the router is back: {new} run the new file, {counts['confirmed']} were said to")
    took, counts = await bench.apply(folder)
    bench.judge("the next run", counts["same"] + counts["confirmed"], bench.count)
    print(f"the next run: {counts['same']} the same, {counts['confirmed']} confirmed", flush=True)


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--parallel", type=int, default=100)
    parser.add_argument("--back", type=float, default=60.0, help="seconds of the bad file")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        await serve(**json.loads(given.serve))
        return
    count, processes = given.gateways, given.processes
    ends = [free_endpoint() for _ in range(3)]
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bench = Bench(ends[2], folder, count, given.parallel)
        first = bench.files("first", 9000)

        async def router(number: int) -> ZenohPeer:
            peer = ZenohPeer("router", [ends[number]], ends[:number])
            return await stack.enter_async_context(peer)

        routers = [await router(number) for number in range(3)]
        running = []
        (own := folder / "own").mkdir()
        for first_number in range(processes):
            numbers = [*range(first_number, count, processes)]
            served = json.dumps({"endpoints": ends, "folder": str(own), "numbers": numbers})
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "benchmarks.fleet", "--serve", served),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
            )
            running.append(process)
        for process in running:
            assert process.stdout is not None
            await process.stdout.readline()
        await seen(bench, first)
        await changed(bench)
        await back_by_itself(bench, given.back)
        await parted(bench, routers[0], partial(router, 0))
        running[0].kill()
        await running[0].wait()
        gone = len(range(0, count, processes))
        quick, rows, _ = await bench.fleet("--folder", first)
        missing = sum(row["state"] == "missing" for row in rows)
        bench.judge("killed", missing, gone)
        print(f"{gone} gateways killed: {missing} missing, in {quick:.1f} s")
        for process in running[1:]:
            process.kill()
            await process.wait()
    if bench.wrong:
        sys.exit("\n".join(bench.wrong))


if __name__ == "__main__":
    asyncio.run(main())
