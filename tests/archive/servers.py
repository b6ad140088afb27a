"""The databases that the archive is tested with, each a process of its own in a folder of its own.

PostgreSQL runs as another user where the tests run as root: it refuses root.
"""

import os
import shutil
import signal
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psycopg

from tests.bridges.test_influx import Influx
from tests.conftest import lacking, needs
from tests.e2e.processes import ROOT, Program, free_port, until

_AS = ("setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups")
_FAST = ("fsync=off", "full_page_writes=off")  # the tests cut no power


def _program(name: str) -> str:
    """Debian keeps the programs of the server in a folder for each version."""
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    return str(found[-1]) if found else needs(name)


class Postgres:
    """A server with an empty database `plant`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.address = f"postgresql://archive@127.0.0.1:{self.port}/plant"
        self._by = _AS if os.geteuid() == 0 else ()
        self.server: Program | None = None
        subprocess.run(
            [*self._by, _program("initdb"), "-D", folder / "data", "-U", "archive", "-A", "trust"],
            check=True,
            capture_output=True,
            cwd="/",
        )

    def start(self) -> None:
        settings = (f"port={self.port}", "listen_addresses=127.0.0.1", *_FAST)
        options = [part for one in settings for part in ("-c", one)]
        where = ("-D", self.folder / "data", "-k", self.folder)
        self.server = Program(*self._by, _program("postgres"), *where, *options)
        until(self._answers, "PostgreSQL answers")

    def kill(self) -> None:
        """As a power cut does: no process of the server can end its work."""
        assert self.server is not None
        with suppress(ProcessLookupError):
            for child in _children(self.server.pid):
                os.kill(child, signal.SIGKILL)
        self.server.end(signal.SIGKILL)
        (self.folder / "data" / "postmaster.pid").unlink(missing_ok=True)

    def clear(self) -> None:
        with psycopg.connect(self.address) as connection:
            connection.execute("DROP TABLE IF EXISTS plc_sample, plc_tag, plc_cursor CASCADE")

    def rows(self, query: str) -> list[tuple[object, ...]]:
        with psycopg.connect(self.address) as connection:
            return connection.execute(query.encode()).fetchall()

    def _answers(self) -> bool:
        base = self.address.rpartition("/")[0]
        try:
            with psycopg.connect(f"{base}/postgres", autocommit=True) as connection:
                known = "SELECT 1 FROM pg_database WHERE datname = 'plant'"
                if connection.execute(known).fetchone() is None:
                    connection.execute("CREATE DATABASE plant")
        except psycopg.OperationalError:
            return False
        return True


def _children(pid: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


class InfluxDb:
    """A server with an empty database `plant`."""

    def __init__(self, folder: Path) -> None:
        self.influx = Influx(needs("influxd"), folder)
        self.address = f"{self.influx.url}/write?db=plant"
        self.server: Program | None = None

    def start(self) -> None:
        self.server = self.influx.run()

    def kill(self) -> None:
        assert self.server is not None
        self.server.end(signal.SIGKILL)


@contextmanager
def influx() -> Iterator[InfluxDb]:
    """Yields a server that runs."""
    with tempfile.TemporaryDirectory(prefix="plc-influx-") as name:
        found = InfluxDb(Path(name))
        try:
            found.start()
            found.influx.query("CREATE DATABASE plant")
            yield found
        finally:
            if found.server is not None:
                found.server.__exit__()


@contextmanager
def s3() -> Iterator[str]:
    """Yields the address of an empty folder on a server of S3 (moto), in memory."""
    server, port = ROOT / "build" / "s3" / "bin" / "moto_server", free_port()
    if not server.exists():
        lacking("there is no moto in build/s3 (.ci/install-peers)")
    with Program(server, "-p", port) as program:
        program.says("Running on")
        bucket = urllib.request.Request(f"http://127.0.0.1:{port}/plant", method="PUT")
        urllib.request.urlopen(bucket, timeout=60).close()  # noqa: S310  (our own)
        options = f"region=us-east-1&scheme=http&endpoint_override=127.0.0.1:{port}"
        yield f"s3://user:of-a-test@plant/archive?{options}"


@contextmanager
def postgres() -> Iterator[Postgres]:
    """Yields a server that runs. Skips the test without PostgreSQL."""
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        lacking("setpriv is not installed")
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="plc-postgres-") as name:
        folder = Path(name)
        if os.geteuid() == 0:
            shutil.chown(folder, "nobody", "nogroup")
        found = Postgres(folder)
        try:
            found.start()
            yield found
        finally:
            if found.server is not None:
                if found.server.running:
                    found.server.end(signal.SIGINT)
                found.server.__exit__()
