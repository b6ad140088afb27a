"""Recordings: limited files, whole lines, and the end on a full disk."""

import os
from pathlib import Path

import pytest

from gateway.cli.trace import FILES, Recording
from gateway.errors import GatewayError
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue, entries, event_lines

LINE = "1795369149.294760 > 20 03 00 04 00 02 83 7b\n"


def test_the_oldest_files_are_deleted(tmp_path: Path) -> None:
    (tmp_path / "hall-1-notes.txt").write_text("kept")
    with Recording(tmp_path, "hall-1", keep=10 * FILES * len(LINE)) as recording:
        for _ in range(40 * FILES):
            recording.add(LINE)
        last = recording.path
    files = sorted(tmp_path.glob("hall-1-*.log"))
    assert len(files) == FILES
    assert last in files
    assert sum(file.stat().st_size for file in files) <= 10 * FILES * len(LINE)
    assert (tmp_path / "hall-1-notes.txt").exists()


def test_a_full_disk_ends_the_recording_after_a_whole_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write
    with Recording(tmp_path, "hall-1", keep=10**6) as recording:
        recording.add(LINE)

        def nearly_full(file: int, data: bytes) -> int:
            monkeypatch.setattr(os, "write", full)
            return write(file, data[:20])

        def full(file: int, data: bytes) -> int:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "write", nearly_full)
        with pytest.raises(GatewayError, match="No space left on device; the gateway goes on"):
            recording.add(LINE)
        text = recording.path.read_text()
    assert text == f"# line hall-1\n{LINE}"


def test_an_event_of_a_trace_is_read_again() -> None:
    exchange = {
        "time": 5.0,
        "took": 0.02,
        "device": "mixer",
        "kind": "read",
        "what": "read D100",
        "result": "speed 12.5",
        "failed": False,
        "values": {"mixer/speed": 12.5, "mixer/steps": (1, 2.5)},
    }
    text = event_lines({"time": 4.9, "way": "<", "bytes": "06 30"}) + event_lines(exchange)
    text += event_lines({**exchange, "failed": True, "result": "heard < 06 30"})
    assert list(entries(text.splitlines())) == [
        LoggedPiece(4.9, "<", b"\x06\x30"),
        LoggedValue(5.02, "mixer/speed", 12.5),
        LoggedValue(5.02, "mixer/steps", (1, 2.5)),
    ]
