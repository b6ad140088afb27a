"""A service of systemd or a container: its disk can only be read, but for the state directory."""

import asyncio
import os
import signal
import socket
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.conftest import forbidden, needs
from tests.e2e.processes import Program, plc_gateway, until, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

# All file systems but those of the kernel, in a namespace of the command alone.
READ_ONLY = """
mount --bind {state} {state}
while read -r _ at _ options _; do
    case $at in {state}|/proc*|/sys*|/dev*) continue ;; esac
    mount -o remount,bind,ro "$at" 2>/dev/null
done < /proc/self/mounts
cd /
! touch {folder}/tried 2>/dev/null && touch {state}/tried && rm {state}/tried || exit 77
"""


@pytest.fixture
def confined(tmp_path: Path) -> str:
    """Returns a command that runs another one without rights and with a read-only disk."""
    needs("unshare")
    needs("setpriv")
    state = tmp_path / "state"
    state.mkdir()
    who = "" if os.geteuid() == 0 else "--map-root-user"
    prepare = tmp_path / "confined.sh"
    bare = "setpriv --no-new-privs --bounding-set=-all --inh-caps=-all"
    prepare.write_text(READ_ONLY.format(state=state, folder=tmp_path) + f'exec {bare} "$@"\n')
    command = f"unshare {who} --mount sh {prepare}"
    with Program(*command.split(), "true") as probe:
        if probe.ended():
            forbidden(f"no file system may be made read-only here: {probe.lines}")
    return command


async def test_only_the_state_directory_is_written_and_systemd_is_told(
    tmp_path: Path, confined: str
) -> None:
    state = tmp_path / "state"
    tags = {"speed": {"address": "D10", "publish": "always", "history": True}}
    lines = {"hall": vigor_line("simulator", tags)}
    file = write_config(tmp_path / "c.yaml", free_endpoint(), lines, history={})
    name = f"plc-gateway-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        systemd.setblocking(False)

        received: list[str] = []
        loop = asyncio.get_running_loop()
        loop.add_reader(systemd, lambda: received.append(systemd.recv(4096).decode()))

        async def hears(text: str) -> None:
            await asyncio.to_thread(until, lambda: text in received, f"systemd hears {text}")
            received.clear()

        variables = (
            f"NOTIFY_SOCKET=@{name}",
            "WATCHDOG_USEC=600000",
            f"STATE_DIRECTORY={state}",
            f"PYTHONPATH={Path.cwd()}",
            "HOME=/nonexistent",
        )
        run = (*confined.split(), sys.executable, "-m", "gateway", "run", file)
        with Program("env", *variables, *run) as gateway:
            await hears("READY=1")
            await asyncio.to_thread(gateway.says, "history ready")
            os.kill(gateway.pid, signal.SIGHUP)  # as `systemctl reload`
            await hears("READY=1")
            await asyncio.to_thread(gateway.says, "file reloaded")
            for _ in range(3):
                await hears("WATCHDOG=1")
            copy = state / "copy.db"
            done = await asyncio.to_thread(
                plc_gateway, "backup", file, copy, env={"STATE_DIRECTORY": str(state)}
            )
            assert done.code == 0, done.err
            assert await asyncio.to_thread(gateway.end) == 0
            await hears("STOPPING=1")
            loop.remove_reader(systemd)
            assert not gateway.has_said("Read-only")
    with closing(sqlite3.connect(copy)) as database:
        assert list(database.execute("SELECT count(*) FROM history")) > [(0,)]
        assert list(database.execute("PRAGMA integrity_check")) == [("ok",)]
    found = {path.name for path in state.iterdir()} - {"copy.db"}
    [lock] = state.glob("gateway-*.lock")
    found -= {lock.name}
    assert found == {"history.db", "history.db.lock", "state.json", "alarms.json", "audit.jsonl"}
    assert {path.name for path in tmp_path.iterdir()} == {"c.yaml", "confined.sh", "state"}
