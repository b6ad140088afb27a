"""What was learned of a device outlives a restart, and a spoilt file costs only a new search."""

from pathlib import Path

import orjson
import pytest

from gateway.device import Device
from gateway.notebook import Notebook
from tests.sim.plant import device, make_tag


def dev(*numbers: int) -> Device:
    return device([make_tag(f"D{n}") for n in numbers])


def searched(numbers: range, culprit: int) -> Device:
    """A device in which the search for one refused address has come to its end."""
    found = dev(*numbers)
    (block,) = found.blocks
    refused = [block]
    while refused:
        block = refused.pop()
        if not block.span.start <= culprit < block.span.start + block.span.size:
            found.refusals.read(block)
            continue
        refused += found.refusals.refused(block, 1_000, "28")
    assert found.refusals.settle()
    found.plan()
    return found


def test_what_was_found_is_planned_around_after_a_restart(tmp_path: Path) -> None:
    before = searched(range(20), 7)
    notebook = Notebook(tmp_path / "state.json")
    notebook.save(notebook.page([before]))
    after = dev(*range(20))
    assert len(after.blocks) == 1
    Notebook(tmp_path / "state.json").recall([after])
    assert [block.span for block in after.blocks] == [block.span for block in before.blocks]
    (bad,) = after.refusals.bad.values()
    assert (bad.since, bad.code, [tag.text for tag in bad.tags]) == (1_000, "28", ["D7"])


def test_addresses_without_a_tag_are_forgotten(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "state.json")
    notebook.save(notebook.page([searched(range(20), 7)]))
    after = dev(1, 2, 3)
    notebook.recall([after])
    assert after.refusals.bad == {}
    assert len(after.blocks) == 1


def test_an_address_that_is_read_in_another_way_now_is_asked_for(tmp_path: Path) -> None:
    """The range that was refused is no item of the new plan: it would stay refused for ever."""
    before = device([make_tag("D100", type="float64")])
    (block,) = before.blocks
    assert not before.refusals.refused(block, 1_000, "28")
    notebook = Notebook(tmp_path / "state.json")
    notebook.save(notebook.page([before]))
    after = dev(100, 102)
    notebook.recall([after])
    assert after.refusals.bad == {}


def test_no_file_is_nothing_known(tmp_path: Path) -> None:
    after = dev(1, 2)
    Notebook(tmp_path / "none.json").recall([after])
    assert len(after.blocks) == 1


@pytest.mark.parametrize(
    "spoilt",
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
    ],
)
def test_a_spoilt_file_is_moved_aside(tmp_path: Path, spoilt: bytes) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(spoilt)
    after = dev(1, 2)
    Notebook(path).recall([after])
    assert not path.exists()
    assert (tmp_path / "state.json.bad").read_bytes() == spoilt


def test_a_disk_that_takes_nothing_stops_nothing(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "no" / "such" / "folder.json")
    notebook.save(notebook.page([dev(1)]))


def test_the_file_is_whole_or_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    notebook = Notebook(path)
    notebook.save(notebook.page([searched(range(20), 7)]))
    assert orjson.loads(path.read_bytes())["form"] == 1
    assert list(tmp_path.iterdir()) == [path]
