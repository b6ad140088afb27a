"""Stations killed, connections cut, gateways restarted, all as real processes."""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.processes import (
    free_port,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

RESTARTS = int(os.environ.get("RESTARTS", "8"))
_OF_SQLITE = ("wal", "shm")
TAGS: dict[str, dict[str, Any]] = {
    "speed": {"address": "D10", "publish": "always"},
    "recipe": {"address": "D500", "write": True},
}


class Cuttable:
    """A TCP proxy between gateway and PLC that cuts in the middle of a reply, or falls silent."""

    def __init__(self, far: int) -> None:
        self._far = far
        self.number = free_port()
        self.cut_after: int | None = None  # bytes of the next reply
        self.hanging = False
        self.connections = 0
        self._open: list[asyncio.StreamWriter] = []

    async def serve(self) -> asyncio.Server:
        return await asyncio.start_server(self._accept, "127.0.0.1", self.number)

    async def _accept(self, near: asyncio.StreamReader, back: asyncio.StreamWriter) -> None:
        self.connections += 1
        far, there = await asyncio.open_connection("127.0.0.1", self._far)
        self._open += [back, there]
        await asyncio.gather(
            self._pass(near, there, replies=False),
            self._pass(far, back, replies=True),
            return_exceptions=True,
        )
        for end in (there, back):
            end.close()

    async def _pass(
        self, source: asyncio.StreamReader, target: asyncio.StreamWriter, *, replies: bool
    ) -> None:
        while data := await source.read(4096):
            if self.hanging:
                continue
            if replies and self.cut_after is not None:
                target.write(data[: self.cut_after])
                await target.drain()
                self.cut_after = None
                self.close()
                return
            target.write(data)
            await target.drain()

    def close(self) -> None:
        """Ends every connection, as a restart of a device server does."""
        for end in self._open:
            end.close()
        self._open.clear()


@asynccontextmanager
async def _proxied(far: int) -> AsyncIterator[Cuttable]:
    proxy = Cuttable(far)
    server = await proxy.serve()
    try:
        yield proxy
    finally:
        proxy.close()
        server.close()
        await asyncio.sleep(0.05)  # its connections notice


def _good(key: str) -> Callable[[Any], bool]:
    return lambda heard: heard.key == key and heard.json["quality"] == "good"


def _bad(key: str) -> Callable[[Any], bool]:
    return lambda heard: heard.key == key and heard.json["quality"] == "bad"


async def test_tcp_cut_in_the_middle_of_a_reply_and_half_open(tmp_path: Path) -> None:
    endpoint, far = free_endpoint(), free_port()
    with station("tcp", str(far)) as plc:
        plc.tell("count 1 D 10")
        async with _proxied(far) as proxy:
            line = vigor_line(f"tcp://127.0.0.1:{proxy.number}", TAGS)
            config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
            with await asyncio.to_thread(started, config) as service:
                async with ZenohPeer("client", connect=[endpoint]) as client:
                    heard = await client.subscribe("plant/mixer/*")
                    await heard.next(_good("plant/mixer/speed"))
                    for length in (1, 5, 9):
                        heard.forget()
                        proxy.cut_after = length
                        told = await heard.next(_bad("plant/mixer/speed"))
                        assert told.json["value"] is None
                        heard.forget()  # good values from before the cut
                        await heard.next(_good("plant/mixer/speed"))
                    # Half open: it is connected, and nothing passes.
                    heard.forget()
                    proxy.hanging = True
                    assert (await heard.next(_bad("plant/mixer/speed"))).json[
                        "reason"
                    ] == "no-reply"
                    [answer] = await client.get("plant/mixer/recipe/@set", b"7")
                    assert answer.json["error"] in ("no-reply", "unclear")
                    heard.forget()
                    proxy.hanging = False
                    proxy.close()
                    await heard.next(_good("plant/mixer/speed"))
                    assert plc.tell("get 1 D 500") == "0"
                assert proxy.connections >= 5
                assert not service.has_said("Traceback")


async def test_a_killed_station_is_online_again_after_its_restart(tmp_path: Path) -> None:
    endpoint, number = free_endpoint(), free_port()
    line = vigor_line(f"tcp://127.0.0.1:{number}", TAGS)
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
    with station("tcp", str(number)) as plc, await asyncio.to_thread(started, config) as service:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe("plant/mixer/*")
            await heard.next(_good("plant/mixer/speed"))
            heard.forget()
            plc.end(signal.SIGKILL)
            assert (await heard.next(_bad("plant/mixer/speed"))).json["reason"] == "line-down"
            with await asyncio.to_thread(station, "tcp", str(number)) as again:
                again.tell("set 1 D 10 77")
                await heard.next(lambda h: _good("plant/mixer/speed")(h) and h.json["value"] == 77)
        assert not service.has_said("Traceback")


def test_restarts_leave_nothing_behind(tmp_path: Path) -> None:
    """Ended and killed by turns, a gateway leaves no process, file, lock or port name, and no file
    descriptor in the process of the PLC. The next start removes the files of SQLite after a kill.
    The lock files stay and are not locked."""
    tty = str(tmp_path / "tty")
    tags = {**TAGS, "speed": {**TAGS["speed"], "history": True}}
    with station("pty", tty) as plc:
        plc.tell("count 1 D 10")
        config = write_config(
            tmp_path / "config.yaml",
            free_endpoint(),
            {"hall": vigor_line(tty, tags)},
            history={"path": str(tmp_path / "history.db")},
        )
        files = set(tmp_path.rglob("*")) | {tmp_path / "history.db", tmp_path / "history.db.lock"}
        kept_open = len(list(Path(f"/proc/{plc.pid}/fd").iterdir()))
        for number in range(RESTARTS):
            kindly = number % 2 == 1
            with started(config) as service:
                service.says("device online")
                assert not service.has_said("line down")
                assert not service.has_said("history failed")
                pid = service.pid
                by = signal.SIGTERM if kindly else signal.SIGKILL
                assert service.end(by) == (0 if kindly else -signal.SIGKILL)
            assert not Path(f"/proc/{pid}").exists()
            assert not _children(pid)
            beside = set() if kindly else {tmp_path / f"history.db-{what}" for what in _OF_SQLITE}
            [lock] = tmp_path.glob("gateway-*.lock")
            beside.add(lock)
            assert set(tmp_path.rglob("*")) - beside == files
        until(lambda: not _holders(tty, plc.pid), "no process holds the port")
        assert len(list(Path(f"/proc/{plc.pid}/fd").iterdir())) == kept_open


def _children(pid: int) -> list[int]:
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[1]) == pid:
            found.append(int(status.parent.name))
    return found


def _holders(tty: str, plc: int) -> list[str]:
    """Returns the processes besides the PLC that have the port open."""
    real, found = os.path.realpath(tty), []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            opened = [os.path.realpath(fd) for fd in (process / "fd").iterdir()]
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            continue
        if real in opened and process.name != str(plc):
            found.append(process.name)
    return found


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-k", "restarts"]))
