"""The supervisor hears of the service: ready, a sign of life for each turn of the loop, the end."""

import asyncio
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from gateway.service.supervisor import Supervisor


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.setblocking(False)
        yield bound


def heard(systemd: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return found


async def hears(systemd: socket.socket, text: str) -> None:
    async with asyncio.timeout(300):
        while text not in heard(systemd):
            await asyncio.sleep(0.005)


def variables(systemd: socket.socket, **others: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "30000", **others}


async def test_ready_status_and_stop_are_reported(systemd: socket.socket) -> None:
    supervisor = Supervisor({"NOTIFY_SOCKET": systemd.getsockname()})
    with supervisor.informed():
        supervisor.ready()
        supervisor.says("serving 3 devices")
        supervisor.reloading()
        supervisor.stopping()
    supervisor.stopping()  # afterwards: too late
    ready, status, reloading, stopping = heard(systemd)
    assert (ready, status, stopping) == ("READY=1", "STATUS=serving 3 devices", "STOPPING=1")
    assert re.fullmatch(r"RELOADING=1\nMONOTONIC_USEC=[0-9]+", reloading)


async def test_a_loop_that_stands_still_gives_no_sign_of_life(systemd: socket.socket) -> None:
    with Supervisor(variables(systemd)).informed():
        await hears(systemd, "WATCHDOG=1")
        heard(systemd)
        time.sleep(0.1)  # the attack itself
        assert heard(systemd) == []
        await hears(systemd, "WATCHDOG=1")
    heard(systemd)
    await asyncio.sleep(0.04)
    assert heard(systemd) == []  # the service has ended


@pytest.mark.parametrize(
    ("process", "signs"), [("1", 0), (str(os.getpid()), 1)], ids=["another", "this"]
)
async def test_signs_of_life_are_those_of_the_process_that_systemd_watches(
    systemd: socket.socket, process: str, signs: int
) -> None:
    with Supervisor(variables(systemd, WATCHDOG_PID=process)).informed():
        assert len(heard(systemd)) == signs


async def test_a_supervisor_that_reads_late_gets_the_report(systemd: socket.socket) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                other.sendto(b"x", systemd.getsockname())
        supervisor = Supervisor(variables(systemd))
        with supervisor.informed():
            supervisor.ready()
            await hears(systemd, "READY=1")


async def test_without_a_supervisor_nothing_happens(systemd: socket.socket, tmp_path: Path) -> None:
    gone = Supervisor({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "3000"})
    for supervisor in (Supervisor({}), gone):
        with supervisor.informed():
            supervisor.ready()
