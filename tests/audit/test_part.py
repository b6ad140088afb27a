"""The audit of a running gateway: on disk within a moment, and it says what it left out."""

import asyncio
import json
import signal
from pathlib import Path
from typing import Any

import pytest

from gateway.parts.audit import part
from gateway.parts.audit.file import checked, read
from gateway.parts.audit.part import AuditPart
from tests.conftest import Command
from tests.e2e.processes import started, until, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint


def records(path: Path) -> list[Any]:
    found = [*checked(read(path))]
    assert [record.why for record in found if record.why] == []
    return [record.event for record in found]


async def test_what_does_not_fit_is_counted_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(part, "MOST_WAITING", 5)
    path = tmp_path / "there" / "audit.jsonl"
    audit = AuditPart(path)
    running = asyncio.create_task(audit.run())
    async with asyncio.timeout(300):
        while not audit.documents()["files/audit"]["trouble"]:
            await asyncio.sleep(0.01)
        for n in range(10):
            audit.audit(1, f'{{"value": {n}}}')
        path.parent.mkdir()
        while audit.documents()["files/audit"]["trouble"]:
            await asyncio.sleep(0.01)
        audit.audit(1, '{"value": 10}')
        running.cancel()
        await asyncio.wait([running])
    begins, *found, ends = records(path)
    assert (begins["event"], ends) == ("begins", {"event": "ends", "left_out": 0})
    assert found == [
        *({"value": n} for n in range(4)),
        {"event": "left out", "records": 6},
        {"value": 10},
    ]


async def asked_by_time(client: ZenohPeer, path: Path) -> None:
    """Each record is served as it is in the file, on a key of its own."""
    key = "plant/@gateway/demo/audit"
    answers = await client.get(f"{key}/*?_time=[now(-1h)..]")
    lines = path.read_bytes().splitlines()
    assert sorted(answer.payload for answer in answers) == sorted(lines)
    assert {answer.key for answer in answers} == {f"{key}/{n + 1}" for n in range(len(lines))}
    third = json.loads(lines[2])["time"]
    [answer] = await client.get(f"{key}/*?_time=[{third}..{third}]")
    assert answer.payload == lines[2]
    assert len(await client.get(f"{key}/*?_time=[..];limit=3")) == 3
    assert await client.get(f"{key}/*?_time=[..2020-01-01T00:00:00Z]") == []
    [wrong] = await client.get(f"{key}/*?_time=yesterday")
    assert wrong.json["error"] == "bad-query"
    assert await client.get(f"{key}/*") == []
    [refused] = await client.get(f"{key}/1", b"?")
    assert refused.json["error"] == "unknown-tag"


async def test_writes_and_acknowledgements_are_there_after_a_kill(
    command: Command, tmp_path: Path
) -> None:
    endpoint, path = free_endpoint(), tmp_path / "audit.jsonl"
    tags = {
        "speed": {"address": "D10", "write": True},
        "level": {"address": "D20", "alarm": {"low": 30_000}},
    }
    file = write_config(
        tmp_path / "plant.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags, reply_timeout="2s")},
        gateway={"name": "demo", "audit": "audit.jsonl"},
        alarms={"path": "alarms.json"},
    )
    with started(file) as first:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            for n in range(5):
                [done] = await client.get("plant/mixer/speed/@set", b"%d" % n)
                assert done.ok
            [refused] = await client.get("plant/mixer/level/@set", b"1")
            assert not refused.ok
            key = "plant/@gateway/demo/alarms/mixer/level"
            await client.get_until(key, lambda alarm: alarm["state"] == "active")
            [acknowledged] = await client.get(key, b'{"by": "Ana"}')
            assert acknowledged.json["state"] == "acknowledged"
            await asyncio.to_thread(until, lambda: b"Ana" in path.read_bytes(), "it is on disk")
            await asked_by_time(client, path)
            first.end(signal.SIGKILL)
    found = records(path)
    assert [one["value"] for one in found if one.get("outcome") == "written"] == list(range(5))
    assert [one["event"] for one in found if "event" in one] == ["begins", "acknowledged"]
    assert len([one for one in found if one.get("outcome") == "not-writable"]) == 1
    printed = command("audit", file)
    assert (printed.code, len(printed.out.splitlines())) == (0, len(found))
    assert command("audit", file, "--time", "[..2020-01-01T00:00:00Z]").out == ""
    path.write_bytes(path.read_bytes().replace(b'"value":3', b'"value":2'))
    changed = command("audit", file)
    assert (changed.code, "was changed: record" in changed.err) == (1, True)
