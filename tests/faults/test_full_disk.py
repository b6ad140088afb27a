"""A full disk: history reports it and waits, all else continues, no sample is lost."""

import asyncio
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import forbidden, needs
from tests.e2e.processes import Program, slowed, vigor_line, write_config
from tests.zenoh_peer import POLL, Received, Subscription, ZenohPeer, free_endpoint

WITHIN = 2.0  # seconds from SIGTERM to the end
SIZE = 8  # MB of the small disk
KEY = "plant/mixer/v0"


def _config(folder: Path, endpoint: str, path: Path) -> Path:
    tags = {f"v{n}": {"address": f"D{n}", "publish": "always"} for n in range(20)}
    return write_config(
        folder / "config.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags, reply_timeout="5s")},
        defaults={"every": "50ms", "history": True},
        history={"path": str(path)},
    )


async def test_a_file_at_its_size_limit_stops_the_history_only(tmp_path: Path) -> None:
    """No file of this process may grow beyond 200 kB."""
    endpoint = free_endpoint()
    config = _config(tmp_path, endpoint, tmp_path / "history.db")
    run = f"ulimit -f 200; exec {sys.executable} -m gateway run {config}"
    with Program("bash", "-c", run) as service:
        await asyncio.to_thread(service.says, "Zenoh session ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe(KEY)
            why = await asyncio.to_thread(service.says, "history failed")
            assert "disk" in why
            heard.forget()
            await heard.next(_good)
        asked = time.monotonic()
        assert await asyncio.to_thread(service.end) == 0
        assert time.monotonic() - asked < slowed(WITHIN)
        assert not service.has_said("Traceback")


@pytest.fixture
def disk(tmp_path: Path) -> tuple[str, Path]:
    """Returns a command prefix that mounts a small disk for its command alone, and the folder."""
    needs("unshare")
    needs("mount")
    place = tmp_path / "disk"
    place.mkdir()
    who = "" if os.geteuid() == 0 else "--map-root-user"
    mount = f"mount -t tmpfs -o size={SIZE}m small {place}"
    with Program("bash", "-c", f"exec unshare {who} --mount bash -c '{mount}'") as probe:
        if probe.ended():
            forbidden(f"no file system may be mounted here: {probe.lines}")
    return f"exec unshare {who} --mount bash -c '{mount} && exec {{}}'", place


async def test_a_full_disk_is_reported_and_history_continues_with_room(
    disk: tuple[str, Path], tmp_path: Path
) -> None:
    mounted, place = disk
    endpoint = free_endpoint()
    config = _config(tmp_path, endpoint, place / "history.db")
    run = mounted.format(f"{sys.executable} -m gateway run {config}")
    with Program("bash", "-c", run) as service:
        await asyncio.to_thread(service.says, "Zenoh session ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe(KEY)
            await heard.next(_good)
            heard.forget()
            ballast = Path(f"/proc/{service.pid}/root{place}/ballast")
            _fill(ballast)
            why = await asyncio.to_thread(service.says, "history failed")
            assert "the disk is full" in why

            # Twenty readings wait, and nothing else notices.
            while (now := await _history(client))["waiting"] < 400:
                _fill(ballast)  # also what SQLite gives up to find its feet
            assert "disk" in now["state"]
            [found] = await client.get("plant/@gateway/demo/devices/mixer")
            assert not any(found.json["failures"].values())

            ballast.unlink()
            await asyncio.to_thread(service.says, "history ready")
            while (now := await _history(client))["waiting"] > 40 or now["state"] != "ok":
                await asyncio.sleep(POLL)  # two readings of twenty tags may be on their way
            assert now["lost"] == 0
            await _is_remembered(client, heard)
            assert all(_good(sample) for sample in heard.samples)
        asked = time.monotonic()
        assert await asyncio.to_thread(service.end) == 0
        assert time.monotonic() - asked < slowed(WITHIN)
        assert not service.has_said("Traceback")


def _fill(ballast: Path) -> None:
    """Fills the disk to the last byte."""
    with ballast.open("ab", buffering=0) as file:
        for size in (65536, 4096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


async def _history(client: ZenohPeer) -> dict[str, Any]:
    [found] = await client.get("plant/@gateway/demo/history")
    document: dict[str, Any] = found.json
    return document


async def _is_remembered(client: ZenohPeer, heard: Subscription) -> None:
    """History holds every received sample once."""
    live = [sample.json["time"] for sample in heard.samples]
    kept = [reply.json["time"] for reply in await client.get(f"{KEY}?_time=[{live[0]}..]")]
    assert len(set(kept)) == len(kept)
    assert set(live) <= set(kept)


def _good(sample: Received) -> bool:
    return bool(sample.json["quality"] == "good")
