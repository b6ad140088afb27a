"""Kills archivers, databases and gateways at random: `make archive KILLS=200 SEED=7`.

Two gateways poll simulated PLCs as fast as they can. A random program is killed by SIGKILL at a
random moment, and started again. In the end the store has each sample that the gateways have on
their disks, once, and the cursors count them. It may have more: those that a gateway had in memory
only when it was killed.
"""

import argparse
import random
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from tests.archive.servers import InfluxDb, Postgres, influx, postgres, s3
from tests.archive.test_archive import (
    Found,
    Hall,
    Sample,
    archived,
    archiver,
    cursors,
    recorded,
    samples,
)
from tests.e2e.processes import Program, until
from tests.zenoh_peer import free_endpoint

LONGEST = 1.5  # seconds between two kills


def archived_in(server: Postgres | InfluxDb) -> Found:
    """InfluxDB has the keys without the prefix."""
    if isinstance(server, InfluxDb):
        points = server.influx.query('SELECT device, "name", good, reason FROM plc')
        return Found(
            (f"{device.partition('-')[0]} plant/{device}/{name}", at, reason)
            for at, device, name, _, reason in points
        )
    rows = server.rows(
        "SELECT key, (extract(epoch FROM time) * 1000000)::bigint, reason FROM plc_history"
    )
    return Found(
        (f"{str(key).split('/')[1].partition('-')[0]} {key}", at, reason)  # type: ignore[misc]  # columns
        for key, at, reason in rows
    )


class Campaign:
    """The programs of a plant, each of which can be killed and started again."""

    def __init__(self, folder: Path, store: object, server: Postgres | InfluxDb | None) -> None:
        self._endpoint, self._store, self._server = free_endpoint(), store, server
        self._halls = [
            Hall(folder, "demo", self._endpoint, listen=[self._endpoint]),
            Hall(folder, "other", self._endpoint, connect=[self._endpoint], mode="client"),
        ]
        self._running: dict[str, Program] = {}
        self._kills: list[tuple[str, int]] = []  # names; microseconds since 1970
        self._start: dict[str, Callable[[], Program]] = {
            "archiver": lambda: archiver(self._store, self._endpoint),
            "demo": self._halls[0].run,
            "other": self._halls[1].run,
        }

    def run(self, kills: int, choice: random.Random) -> Found:
        """Returns the samples, after all of them are compared."""
        with ExitStack() as ends:
            ends.callback(self._end_all)
            for name in ("demo", "other", "archiver"):
                self._running[name] = self._start[name]()
            self._running["archiver"].says("archived after")
            for number in range(kills):
                time.sleep(choice.uniform(0, LONGEST))  # the random moment
                self._kill(choice.choice(self._names()))
                if number % 20 == 19:
                    print(f"{number + 1} kills, {self._count()} samples", flush=True)
        with (
            self._halls[0].run(idle=True),
            self._halls[1].run(idle=True),
            archiver(self._store, self._endpoint) as last,
        ):
            try:
                until(self._is_whole, "each sample is there once")
            except AssertionError as error:
                raise AssertionError(f"{error}\n{self._difference()}") from None
            assert last.end() == 0
        found = self._archived()
        assert self._count() == found.total()
        return found

    def _names(self) -> list[str]:
        often = ["archiver"] * 3  # it is up soonest
        return [*often, "demo", "other", *(["database"] if self._server else [])]

    def _kill(self, name: str) -> None:
        if name == "database":
            assert self._server is not None
            self._server.kill()
            self._server.start()
            return
        self._end(name)
        self._running[name] = self._start[name]()

    def _end(self, name: str) -> None:
        if (program := self._running.pop(name)).running:
            program.end(signal.SIGKILL)
        self._kills.append((name, time.time_ns() // 1000))

    def _end_all(self) -> None:
        for name in [*self._running]:
            self._end(name)

    def _archived(self) -> Found:
        return archived(self._store) if self._server is None else archived_in(self._server)

    def _count(self) -> int:
        return sum(samples(self._store).values())

    def _truth(self) -> Found:
        return sum((recorded(hall.history, hall.name) for hall in self._halls), Found())

    def _difference(self) -> str:
        """Names the samples on one side only, beside the cursors."""
        truth, found = self._truth(), self._archived()
        sides = (("only in the histories", truth - found), ("only in the store", found - truth))
        shown = [f"{len(one)} {where}: {sorted(one, key=str)[:20]}" for where, one in sides]
        return "\n".join([*shown, *map(str, cursors(self._store).values())])

    def _is_whole(self) -> bool:
        truth = self._truth()
        found = self._archived()
        assert all(truth[one] == 1 for one in truth), "two samples of one time"
        doubled = [one for one, count in found.items() if count > 1]
        assert not doubled, doubled[:5]
        strange = [one for one in found - truth if not self._was_in_memory(one, truth)]
        assert not strange, strange[:5]
        return truth <= found

    def _was_in_memory(self, sample: Sample, truth: Found) -> bool:
        """True if the next kill of its gateway came before a later sample was on the disk."""
        at, gateway = sample[1], sample[0].partition(" ")[0]
        killed = min(
            (kill for name, kill in self._kills if name == gateway and kill > at), default=0
        )
        is_last = all(
            not at < time < killed for key, time, _ in truth if key.startswith(f"{gateway} ")
        )
        return bool(killed) and is_last


def campaign(store: str, kills: int, seed: int) -> int:
    """Returns the number of samples. Raises `AssertionError` for a lost or doubled one."""
    choice = random.Random(seed)
    with tempfile.TemporaryDirectory() as name, ExitStack() as ends:
        server: Postgres | InfluxDb | None = None
        if store == "postgres":
            server = ends.enter_context(postgres())
        elif store == "influx":
            server = ends.enter_context(influx())
        place: object = Path(name) / "archive" if server is None else server.address
        if store == "s3":
            place = ends.enter_context(s3())
        return Campaign(Path(name), place, server).run(kills, choice).total()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="shared by the stores")
    parser.add_argument("--store", nargs="*", default=["parquet", "s3", "postgres", "influx"])
    parser.add_argument("--seed", type=int, default=int(time.time()))
    given = parser.parse_args()
    kills = given.kills // len(given.store)
    for store in given.store:
        print(f"{store}, seed {given.seed}", flush=True)
        samples = campaign(store, kills, given.seed)
        print(f"{store}: {kills} kills, {samples} samples, none lost, none double", flush=True)


if __name__ == "__main__":
    main()
