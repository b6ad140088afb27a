"""Alarms of a real gateway: a silent PLC and a restart neither clear nor forget one."""

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.e2e.processes import (
    gateway,
    plc_gateway,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import Received, ZenohPeer, free_endpoint

SPEED = "plant/@gateway/demo/alarms/mixer/speed"


@contextmanager
def no_room(path: Path) -> Iterator[None]:
    """A file cannot be saved, as on a full disk: a folder has the name of its next content."""

    def made() -> bool:
        with suppress(FileExistsError):  # it is being saved
            path.mkdir()
        return path.is_dir()

    until(made, "the folder is there")
    yield
    path.rmdir()


def seen(state: str, quality: str) -> Callable[[Received], bool]:
    def matches(sample: Received) -> bool:
        found = sample.json
        return sample.key == SPEED and (found["state"], found["quality"]) == (state, quality)

    return matches


async def test_an_alarm_survives_bad_values_and_a_restart(tmp_path: Path) -> None:
    endpoint, pty = free_endpoint(), tmp_path / "pty"
    alarm = {"high": 80, "hysteresis": 5, "delay": "300ms", "text": "too fast"}
    line = vigor_line(str(pty), {"speed": {"address": "D10", "alarm": alarm}})
    file = write_config(
        tmp_path / "plant.yaml",
        endpoint,
        {"hall": line},
        history={"path": "history.db"},
        alarms={"path": "alarms.json"},
    )
    with station("pty", str(pty)) as plc:
        with started(file) as first:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                changes = await client.subscribe("plant/@gateway/demo/alarms/**")
                plc.tell("set 1 D 10 85")
                active = (await changes.next(seen("active", "good"))).json
                assert (active["level"], active["limit"], active["value"]) == ("high", 80, 85)
                plc.tell("mute 1")
                await changes.next(seen("active", "bad"))
                done = plc_gateway("alarms", file, "--ack", "mixer/speed", "--by", "Ana")
                assert (done.code, "acknowledged by Ana" in done.out) == (0, True)
                await changes.next(seen("acknowledged", "bad"))
                # The device is an alarm too; the line is none.
                [refused] = await client.get(SPEED.replace("mixer/speed", "line:hall"), b'{"by":1}')
                assert refused.json["error"] == "bad-value"
            assert first.end() == 0
        with gateway("run", file) as second:
            second.says("Zenoh session ready")
            async with ZenohPeer("client", connect=[endpoint]) as client:
                [reply] = await client.get(SPEED)
                assert (reply.json["state"], reply.json["quality"]) == ("acknowledged", "bad")
                assert reply.json["acknowledged"]["by"] == "Ana"
                assert reply.json["raised"] == active["raised"]
                changes = await client.subscribe("plant/@gateway/demo/alarms/**")
                plc.tell("set 1 D 10 76")  # within the hysteresis
                plc.tell("speak 1")
                await changes.next(seen("acknowledged", "good"))
                plc.tell("set 1 D 10 75")
                await changes.next(seen("normal", "good"))
                rows = await client.get(f"{SPEED}?_time=[..]", consolidation="NONE")
                events = [row.json["event"] for row in rows]
                assert events == ["raised", "acknowledged", "ended"]
            assert second.end() == 0


async def test_an_acknowledgement_survives_a_kill(tmp_path: Path) -> None:
    """Eight alarms: each is acknowledged, answered, and still acknowledged after `kill -9`.

    One that the disk does not take is refused, and said.
    """
    endpoint = free_endpoint()
    tags = {f"t{n}": {"address": f"D{n}", "alarm": {"low": 30_000}} for n in range(8)}
    lines = {"hall": vigor_line("simulator", tags)}
    file = write_config(tmp_path / "plant.yaml", endpoint, lines, alarms={"path": "alarms.json"})
    keys = [f"plant/@gateway/demo/alarms/mixer/t{n}" for n in range(8)]
    with started(file) as first:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            changes = await client.subscribe("plant/@gateway/demo/alarms/mixer/*")
            replies = await client.get("plant/@gateway/demo/alarms/mixer/*")
            active = {r.json["alarm"] for r in replies if r.json["state"] == "active"}
            for n in range(8):
                if f"mixer/t{n}" not in active:
                    await changes.next(_is_active(f"mixer/t{n}"))
            with no_room(tmp_path / "alarms.json.new"):
                [refused] = await client.get(keys[0], b'{"by": "Ana"}')
                assert refused.json["error"] == "busy"
                done = await asyncio.to_thread(plc_gateway, "status", file)
                assert (done.code, "alarms not saved: Is a directory" in done.out) == (1, True)
            waiting = keys
            async with asyncio.timeout(300):
                while waiting:  # a slow disk is told as such
                    answers = await client.many([(key, b'{"by": "Ana"}') for key in waiting])
                    waiting = [k for k, [one] in zip(waiting, answers, strict=True) if not one.ok]
            first.end(signal.SIGKILL)
    with gateway("run", file) as second:
        second.says("Zenoh session ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            after = await client.get("plant/@gateway/demo/alarms/mixer/*")
            assert [one.json["state"] for one in after] == ["acknowledged"] * 8
        assert second.end() == 0


def _is_active(alarm: str) -> Callable[[Received], bool]:
    return lambda sample: (sample.json["alarm"], sample.json["state"]) == (alarm, "active")
