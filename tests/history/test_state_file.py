"""What was learned of a device outlives a restart, and a spoilt file costs only a new search."""

import os
from pathlib import Path

import orjson
import pytest
from structlog.testing import capture_logs

from gateway.engine.device import Device
from gateway.history.state_file import Notebook
from gateway.northbound.status import refused_sentence
from tests.e2e.processes import PATIENCE
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
            found.bad_addresses.read(block)
            continue
        refused += found.bad_addresses.refused(block, 1_000, "28")
    assert found.bad_addresses.settle()
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
    (bad,) = after.bad_addresses.bad.values()
    assert (bad.since, bad.code, [tag.text for tag in bad.tags]) == (1_000, "28", ["D7"])


def test_addresses_without_a_tag_are_forgotten(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "state.json")
    notebook.save(notebook.page([searched(range(20), 7)]))
    after = dev(1, 2, 3)
    notebook.recall([after])
    assert after.bad_addresses.bad == {}
    assert len(after.blocks) == 1


def test_an_address_that_is_read_in_another_way_now_is_asked_for(tmp_path: Path) -> None:
    """The range that was refused is no item of the new plan: it would stay refused for ever."""
    before = device([make_tag("D100", type="float64")])
    (block,) = before.blocks
    assert not before.bad_addresses.refused(block, 1_000, "28")
    notebook = Notebook(tmp_path / "state.json")
    notebook.save(notebook.page([before]))
    after = dev(100, 102)
    notebook.recall([after])
    assert after.bad_addresses.bad == {}


def test_no_file_is_nothing_known(tmp_path: Path) -> None:
    after = dev(1, 2)
    Notebook(tmp_path / "none.json").recall([after])
    assert len(after.blocks) == 1


def _since(time: int) -> bytes:
    row = f'{{"area": "D", "start": 1, "size": 1, "since": "{time}", "code": "28"}}'
    return f'{{"form": 1, "devices": {{"plc1": {{"refused": [{row}], "cuts": []}}}}}}'.encode()


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
        _since(-1),
        _since(10**30),
        _since(2**63),
    ],
)
def test_a_spoilt_file_is_moved_aside(tmp_path: Path, spoilt: bytes) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(spoilt)
    after = dev(1, 2)
    Notebook(path).recall([after])
    assert not path.exists()
    assert (tmp_path / "state.json.bad").read_bytes() == spoilt


def test_a_spoilt_file_that_cannot_be_moved_aside_is_written_over(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(b"{")
    (tmp_path / "state.json.bad").mkdir()
    notebook = Notebook(path)
    notebook.recall([dev(1, 2)])
    notebook.save(notebook.page([dev(1, 2)]))
    assert orjson.loads(path.read_bytes())["form"] == 1


def test_the_latest_time_that_can_be_shown_is_known(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(_since(2**63 - 1))
    after = dev(1, 2)
    Notebook(path).recall([after])
    [bad] = after.bad_addresses.bad.values()
    assert refused_sentence(after, bad).endswith("since 2262-04-11T23:47:16.854775Z")


def test_what_could_not_be_written_once_is_tried_again(tmp_path: Path) -> None:
    path, in_the_way = tmp_path / "state.json", tmp_path / "state.json.new"
    notebook = Notebook(path)
    page = notebook.page([dev(1)])
    in_the_way.mkdir()
    with capture_logs() as said:
        notebook.save(page)
        notebook.save(page)
    assert len(said) == 1
    in_the_way.rmdir()
    notebook.save(page)
    assert path.read_bytes() == page


def test_a_disk_that_stands_still_holds_up_nobody_and_gets_the_last_page(tmp_path: Path) -> None:
    path, still = tmp_path / "state.json", tmp_path / "state.json.new"
    os.mkfifo(still)  # whose writer waits for a reader
    notebook = Notebook(path)
    notebook.start()
    for number in range(5):
        notebook.keep(notebook.page([dev(number)]))
    last = notebook.page([searched(range(20), 7)])
    notebook.end(last)
    assert not notebook.close(0.0)
    aside = still.rename(tmp_path / "aside")
    moving = os.open(aside, os.O_RDONLY | os.O_NONBLOCK)
    assert notebook.close(PATIENCE)
    os.close(moving)
    assert path.read_bytes() == last


def test_a_disk_that_takes_nothing_stops_nothing(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "no" / "such" / "folder.json")
    notebook.save(notebook.page([dev(1)]))


def test_the_file_is_whole_or_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    notebook = Notebook(path)
    notebook.save(notebook.page([searched(range(20), 7)]))
    assert orjson.loads(path.read_bytes())["form"] == 1
    assert list(tmp_path.iterdir()) == [path]
