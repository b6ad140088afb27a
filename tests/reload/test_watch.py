"""A changed file is noticed when its content is another one and it stood still for a second."""

import os
from pathlib import Path

from gateway.service.reload.reloader import STILL, Watch


def test_a_change_counts_when_the_file_stood_still(tmp_path: Path) -> None:
    file, sheet = tmp_path / "c.yaml", tmp_path / "tags.csv"
    files = [file, sheet]
    file.write_text("a")
    sheet.write_text("1")
    watch = Watch()
    watch.note(files)
    assert not watch.changed(files, 0.0)
    file.write_text("ab")
    assert not watch.changed(files, 10.0)
    file.write_text("abc")  # the editor is still writing
    assert not watch.changed(files, 10.9)
    assert not watch.changed(files, 11.5)
    assert watch.changed(files, 10.9 + STILL)
    assert not watch.changed(files, 20.0)
    sheet.write_text("12")
    assert not watch.changed(files, 30.0)
    assert watch.changed(files, 30.0 + STILL)


def test_a_file_that_was_only_touched_or_is_being_replaced_changes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("a")
    watch = Watch()
    watch.note([file])
    os.utime(file, (1, 1))
    assert not watch.changed([file], 0.0)
    assert not watch.changed([file], STILL)
    file.unlink()
    assert not watch.changed([file], 10.0)
    file.write_text("a")
    assert not watch.changed([file], 10.0 + STILL)
    assert not watch.changed([file], 10.0 + 3 * STILL)
