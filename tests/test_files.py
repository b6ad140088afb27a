"""Reading files that people write: no kind of file blocks, ends the process or fills the memory."""

import os
import socket
import urllib.error
from pathlib import Path

import pytest

from gateway import files
from gateway.errors import words_of


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device", "a.new"), "No space left on device"),
        (
            urllib.error.URLError(ConnectionRefusedError(111, "Connection refused")),
            "Connection refused",
        ),
        (ValueError("no number"), "no number"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_an_error_is_said_without_the_number_of_the_system(error: Exception, words: str) -> None:
    assert words_of(error) == words


def test_a_regular_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"12345")
    assert (files.read(file), files.read(file, 5)) == (b"12345", b"12345")
    assert files.is_file(file)


def test_a_file_over_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    file = tmp_path / "a"
    with file.open("wb") as sparse:
        sparse.truncate(700 * 2**20)
    with pytest.raises(OSError, match="it has more than 32 MB"):
        files.read(file)


def test_a_file_that_does_not_say_its_size_is_read_up_to_the_limit() -> None:
    file = Path("/proc/self/status")
    assert file.stat().st_size == 0
    assert files.read(file)
    with pytest.raises(OSError, match="it has more than 0 MB"):
        files.read(file, 10)


def test_anything_else_is_refused_at_once(tmp_path: Path) -> None:
    """A pipe has no writer here: opened to be read it would wait for one."""
    pipe, folder, loop, sock = (tmp_path / name for name in ("pipe", "folder", "loop", "socket"))
    os.mkfifo(pipe)
    folder.mkdir()
    loop.symlink_to(loop)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(sock))
        others = (pipe, folder, loop, sock, tmp_path / "missing", Path("/dev/zero"))
        for other in (*others, tmp_path / ("a" * 300), Path("a\0b"), Path("\ud800")):
            with pytest.raises(OSError, match=r"\w"):
                files.read(other)
            assert not files.is_file(other)
            assert not files.are_same(tmp_path / "one", other)


def test_one_file_with_two_names_is_one(tmp_path: Path) -> None:
    file, link, hard = tmp_path / "a", tmp_path / "b", tmp_path / "c"
    file.touch()
    link.symlink_to(file)
    hard.hardlink_to(file)
    assert files.are_same(file, link)
    assert files.are_same(hard, file)
    file.unlink()
    assert not files.are_same(hard, file)
    assert files.are_same(file, link), "it would be one, when it is written"


@pytest.mark.parametrize(
    "name", ["", ".", "/", "..", "a/..", "a\0b", "a" * 256, "a/" * 2001, "\ud800"]
)
def test_names_that_no_file_has(name: str) -> None:
    assert not files.is_name(name)


@pytest.mark.parametrize("name", ["a", "/a/b", "../a", "a" * 255, "~/x", "übung é"])
def test_names_that_a_file_can_have(name: str) -> None:
    assert files.is_name(name)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    file, new = tmp_path / "a", tmp_path / "a.new"
    new.write_bytes(b"of a program that was killed")
    files.put(file, b"1")
    assert (file.read_bytes(), file.stat().st_mode & 0o777) == (b"1", 0o600)
    files.put(file, b"2", 0o100664)
    assert (file.read_bytes(), file.stat().st_mode & 0o777) == (b"2", 0o664)
    new.mkdir()  # as if the disk refused it
    with pytest.raises(OSError, match=r"a\.new"):
        files.put(file, b"3")
    assert file.read_bytes() == b"2"
    new.rmdir()
    assert [*tmp_path.iterdir()] == [file]
