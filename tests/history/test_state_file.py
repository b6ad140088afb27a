"""The state file: bad addresses survive a restart, and a damaged file costs only a new search."""

import os
from pathlib import Path
from threading import Event

import orjson
import pytest
from structlog.testing import capture_logs

from gateway.contract.status import refused_sentence
from gateway.engine.device.device import Device
from gateway.parts.state.part import StateFile
from tests.e2e.processes import PATIENCE
from tests.sim.plant import device, make_tag


def dev(*numbers: int) -> Device:
    return device([make_tag(f"D{n}") for n in numbers])


def searched(numbers: range, culprit: int) -> Device:
    """A device after a complete search for one refused address."""
    found = dev(*numbers)
    (block,) = found.blocks
    refused = [block]
    while refused:
        block = refused.pop()
        if not block.span.start <= culprit < block.span.start + block.span.size:
            found.bad_addresses.read(block)
            continue
        refused += found.bad_addresses.refused(block, 1_000, "28")
    assert found.bad_addresses.settle(0.0)
    found.plan()
    return found


def test_refused_addresses_are_avoided_after_a_restart(tmp_path: Path) -> None:
    before = searched(range(20), 7)
    state_file = StateFile(tmp_path / "state.json")
    state_file.save(state_file.snapshot([before]))
    after = dev(*range(20))
    assert len(after.blocks) == 1
    StateFile(tmp_path / "state.json").restore([after])
    assert [block.span for block in after.blocks] == [block.span for block in before.blocks]
    (bad,) = after.bad_addresses.bad.values()
    assert (bad.since, bad.code, [tag.text for tag in bad.tags]) == (1_000, "28", ["D7"])


def test_the_file_is_closed_to_other_users(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_text("{}")
    path.with_name("state.json.new").write_text("of a gateway that was killed")
    state_file = StateFile(path)
    state_file.save(state_file.snapshot([]))
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_device_without_a_plan_is_planned_later(tmp_path: Path) -> None:
    """At the start of a large plant a thread plans, beside the event loop."""
    before = searched(range(20), 7)
    state_file = StateFile(tmp_path / "state.json")
    state_file.save(state_file.snapshot([before]))
    after = Device(before.settings, before.wire, plan_now=False)
    state_file.restore([after])
    assert not after.blocks
    after.plan()
    assert [block.span for block in after.blocks] == [block.span for block in before.blocks]


def test_addresses_without_a_tag_are_forgotten(tmp_path: Path) -> None:
    state_file = StateFile(tmp_path / "state.json")
    state_file.save(state_file.snapshot([searched(range(20), 7)]))
    after = dev(1, 2, 3)
    state_file.restore([after])
    assert after.bad_addresses.bad == {}
    assert len(after.blocks) == 1


def test_an_address_with_another_type_is_read_again(tmp_path: Path) -> None:
    """The refused range is no item of the new plan: it would stay refused for ever."""
    before = device([make_tag("D100", type="float64")])
    (block,) = before.blocks
    assert not before.bad_addresses.refused(block, 1_000, "28")
    state_file = StateFile(tmp_path / "state.json")
    state_file.save(state_file.snapshot([before]))
    after = dev(100, 102)
    state_file.restore([after])
    assert after.bad_addresses.bad == {}


def test_without_a_file_nothing_is_restored(tmp_path: Path) -> None:
    after = dev(1, 2)
    StateFile(tmp_path / "none.json").restore([after])
    assert len(after.blocks) == 1


def _since(time: int) -> bytes:
    row = f'{{"area": "D", "start": 1, "size": 1, "since": "{time}", "code": "28"}}'
    return f'{{"form": 1, "devices": {{"plc1": {{"refused": [{row}], "cuts": []}}}}}}'.encode()


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b'{"form": 2, "devices": {}}',
        b'{"form": 1, "devices": {"plc": {"refused": [{"area": "D"}], "cuts": []}}}',
        b'{"form": 1, "devices": {"plc": {"refused": [], "cuts": [["D"]]}}}',
        b'{"form": 1, "devices": {"plc": {"refused": 3, "cuts": []}}}',
        b"\xff\xfe",
        _since(-1),
        _since(10**30),
        _since(2**63),
    ],
)
def test_a_damaged_file_is_moved_aside(tmp_path: Path, damaged: bytes) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(damaged)
    after = dev(1, 2)
    StateFile(path).restore([after])
    assert not path.exists()
    assert (tmp_path / "state.json.bad").read_bytes() == damaged


def test_a_damaged_file_that_cannot_be_moved_aside_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(b"{")
    (tmp_path / "state.json.bad").mkdir()
    state_file = StateFile(path)
    state_file.restore([dev(1, 2)])
    state_file.save(state_file.snapshot([dev(1, 2)]))
    assert orjson.loads(path.read_bytes())["form"] == 1


def test_the_latest_possible_time_is_restored(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(_since(2**63 - 1))
    after = dev(1, 2)
    StateFile(path).restore([after])
    [bad] = after.bad_addresses.bad.values()
    assert refused_sentence(after, bad).endswith("since 2262-04-11T23:47:16.854775Z")


def test_a_failed_save_is_repeated(tmp_path: Path) -> None:
    path, in_the_way = tmp_path / "state.json", tmp_path / "state.json.new"
    state_file = StateFile(path)
    snapshot = state_file.snapshot([dev(1)])
    in_the_way.mkdir()
    with capture_logs() as logged:
        state_file.save(snapshot)
        state_file.save(snapshot)
    assert len(logged) == 1
    in_the_way.rmdir()
    state_file.save(snapshot)
    assert path.read_bytes() == snapshot


def test_a_stalled_disk_delays_nothing_and_gets_the_last_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, stalled, moves = tmp_path / "state.json", Event(), Event()

    def fsync(number: int) -> None:
        stalled.set()
        assert moves.wait(PATIENCE)
        real(number)

    real = os.fsync
    monkeypatch.setattr(os, "fsync", fsync)
    state_file = StateFile(path)
    state_file.start()
    for number in range(5):
        state_file.save_soon(state_file.snapshot([dev(number)]))
    assert stalled.wait(PATIENCE)
    last = state_file.snapshot([searched(range(20), 7)])
    state_file.save_last(last)
    assert not state_file.close(0.0)
    assert not path.exists()
    moves.set()
    assert state_file.close(PATIENCE)
    assert path.read_bytes() == last


def test_a_folder_that_does_not_exist_raises_nothing(tmp_path: Path) -> None:
    state_file = StateFile(tmp_path / "no" / "such" / "folder.json")
    state_file.save(state_file.snapshot([dev(1)]))


def test_a_save_leaves_no_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    state_file = StateFile(path)
    state_file.save(state_file.snapshot([searched(range(20), 7)]))
    assert orjson.loads(path.read_bytes())["form"] == 1
    assert list(tmp_path.iterdir()) == [path]
