"""A network file system hangs under the configuration, the tokens and the writers."""

import asyncio
import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path

import pytest

from tests.attacks.test_security_writers import Writer
from tests.conftest import forbidden
from tests.e2e.processes import PATIENCE, Program, free_port, until, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

# The command itself; it is only less patient with a file that it reloads.
RUN = """
import gateway.service.reload.reloader as reloader
reloader.READ_WITHIN = 2.0
from gateway.cli.main import main
main()
"""
TOKEN, ALICE = "t" * 40, "alice:" + "a" * 40
_DETACHED = 2


@contextmanager
def hanging(folder: Path) -> Iterator[None]:
    """Mounts a file system that answers nothing. At its end all that waits for it fails."""
    system = ctypes.CDLL(None, use_errno=True)
    try:
        device = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
    except OSError as error:
        forbidden(f"/dev/fuse: {error.strerror}")
    try:
        options = f"fd={device},rootmode=40000,user_id=0,group_id=0".encode()
        if system.mount(b"hang", bytes(folder), b"fuse", 0, options):
            forbidden(f"a mount: {os.strerror(ctypes.get_errno())}")
        try:
            yield
        finally:
            system.umount2(bytes(folder), _DETACHED)
    finally:
        os.close(device)


def answer(port: int, path: str, token: str = "") -> int:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    with closing(connection):
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status


@pytest.mark.skipif(sys.platform != "linux", reason="FUSE")
async def test_the_gateway_goes_on_while_its_files_hang(tmp_path: Path) -> None:
    endpoint, port, net = free_endpoint(), free_port(), tmp_path / "net"
    net.mkdir()
    secret(net / "tokens.txt", f"page:{TOKEN}\n")
    secret(net / "writers.txt", ALICE + "\n")
    tags = {"speed": {"address": "D100"}, "recipe": {"address": "D500", "write": True}}
    file = write_config(
        net / "plant.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags)},
        gateway={"name": "demo", "watch_config": True},
        web={"listen": f"0.0.0.0:{port}", "tokens_file": "tokens.txt"},
        writers={"file": "writers.txt"},
    )
    with Program(sys.executable, "-c", RUN, "run", file) as gateway:
        gateway.says("Zenoh session ready")
        gateway.says("web page ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            alice = Writer(client, ALICE)
            await alice.until("ok")
            assert await asyncio.to_thread(answer, port, "/api/status", TOKEN) == 200
            with hanging(net):
                os.kill(gateway.pid, signal.SIGHUP)
                for n in range(20):
                    assert await asyncio.to_thread(answer, port, "/healthz") == 200
                    assert (await client.get("plant/mixer/speed"))[0].ok
                    assert await alice.says(b"%d" % (n + 1), alice.signed(b"%d" % (n + 1)))
                await asyncio.to_thread(gateway.says, "file refused", "does not answer")
                # What nobody can look up holds no secret after a while: no write, no reading.
                await alice.until("not-allowed")
                closed = lambda: answer(port, "/api/status", TOKEN) == 401  # noqa: E731
                await asyncio.to_thread(until, closed, "the tokens do not count")
                assert await asyncio.to_thread(answer, port, "/readyz") == 200
            await alice.until("ok")
            opened = lambda: answer(port, "/api/status", TOKEN) == 200  # noqa: E731
            await asyncio.to_thread(until, opened, "the tokens count again")
            os.kill(gateway.pid, signal.SIGHUP)
            await asyncio.to_thread(gateway.says, "file reloaded")
        assert not gateway.has_said("gateway stood still")
        assert not gateway.has_said("Traceback")
