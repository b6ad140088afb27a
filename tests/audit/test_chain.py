"""The records of the audit: a change of any of them is seen."""

import json
import os
import subprocess
import sys
from pathlib import Path

import orjson
import pytest

from gateway.parts.audit.file import OLDER, AuditFile, Event, checked, read
from tests.e2e.processes import vigor_line, write_config
from tests.zenoh_peer import free_endpoint

NOON = 1_795_262_400 * 10**9


def events(count: int, start: int = 0) -> list[Event]:
    return [Event(NOON + n, json.dumps({"value": n})) for n in range(start, start + count)]


def broken(path: Path) -> list[str]:
    return [record.why for record in checked(read(path)) if record.why]


def values(path: Path) -> list[int]:
    return [record.event["value"] for record in checked(read(path))]


def test_records_go_on_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    for start in range(0, 30, 10):
        AuditFile(path).append(events(10, start))
    assert values(path) == list(range(30))
    assert broken(path) == []
    assert [record.number for record in checked(read(path))] == list(range(1, 31))
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("how", ["changed", "taken out", "moved", "put in", "no record"])
def test_a_change_is_seen(tmp_path: Path, how: str) -> None:
    path = tmp_path / "audit.jsonl"
    AuditFile(path).append(events(20))
    lines = path.read_bytes().splitlines()
    match how:
        case "changed":
            lines[7] = lines[7].replace(b'"value":7', b'"value":8')
        case "taken out":
            del lines[7]
        case "moved":
            lines[7], lines[8] = lines[8], lines[7]
        case "put in":
            lines.insert(7, orjson.dumps({**orjson.loads(lines[6]), "n": 8}))
        case "no record":
            lines[7] = b"?"
    path.write_bytes(b"\n".join(lines) + b"\n")
    assert broken(path)


def test_records_are_found_while_the_file_is_renamed_and_written(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = AuditFile(path, most=2000)
    file.append(events(3))
    found = read(path)
    first = next(found)
    for n in range(3, 60):
        file.append(events(1, n))
    seen = [first, *found]
    assert seen == [*read(path)][: len(seen)]
    with path.open("ab") as written:
        written.write(b'{"n":99,"time":"2026-11-21T')
    assert values(path) == list(range(60))


def test_the_files_are_bounded_and_their_chain_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = AuditFile(path, most=2000)
    for n in range(300):
        file.append(events(1, n))
    assert len([*tmp_path.iterdir()]) == OLDER + 1
    assert sum(one.stat().st_size for one in tmp_path.iterdir()) <= 2000 * (OLDER + 1)
    found = values(path)
    assert found == list(range(found[0], 300))
    assert found[0] > 0
    assert broken(path) == []


def test_a_line_without_an_end_is_no_record(tmp_path: Path) -> None:
    """As a power cut leaves it."""
    path = tmp_path / "audit.jsonl"
    AuditFile(path).append(events(3))
    with path.open("ab") as file:
        file.write(b'{"n": 4, "ti')
    AuditFile(path).append(events(2, 3))
    assert values(path) == list(range(5))
    assert broken(path) == []


def test_a_write_that_fails_leaves_no_half_record(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = AuditFile(path)
    file.append(events(3))
    path.rename(tmp_path / "kept")
    os.mkfifo(path)  # cannot be synced or truncated
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(OSError):  # noqa: PT011  (its text is the system's)
        file.append(events(1, 3))
    os.close(reader)
    path.unlink()
    (tmp_path / "kept").rename(path)
    file.append(events(2, 3))
    assert values(path) == list(range(5))
    assert broken(path) == []


def test_the_audit_ends_quietly_with_its_reader(tmp_path: Path) -> None:
    """As in `plc-gateway audit … | head -1`."""
    config = write_config(
        tmp_path / "plant.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", {})},
        gateway={"name": "demo", "audit": "audit.jsonl"},
    )
    AuditFile(tmp_path / "audit.jsonl").append(events(5_000))
    audit = f"{sys.executable} -m gateway audit {config} | head -n 1"
    done = subprocess.run(["sh", "-c", audit], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["value"] == 0
    assert done.stderr == ""
