"""Files that the gateway writes are below $STATE_DIRECTORY, others beside its configuration."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.parts.history.settings import HistorySection
from tests.e2e.processes import vigor_line, write_config

LINES = {"hall": vigor_line("simulator", {"t": {"address": "D1"}})}
ENDPOINT = "tcp/127.0.0.1:7447"


def test_without_a_state_directory_files_are_beside_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    file = write_config(tmp_path / "c.yaml", ENDPOINT, LINES, history={})
    config = load(file)
    history = config.part(HistorySection)
    assert history is not None
    assert history.path == tmp_path / "history.db"
    assert config.state_file is None


@pytest.mark.parametrize("value", ["/var/lib/plc", "/var/lib/plc:/var/lib/other"])
def test_with_one_relative_paths_are_below_it_and_there_is_a_state_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", value)
    (tmp_path / "secret.txt").write_text("x" * 32)
    gateway = {"name": "demo", "secret_file": "secret.txt"}
    file = write_config(tmp_path / "c.yaml", ENDPOINT, LINES, history={}, gateway=gateway)
    config = load(file)
    history = config.part(HistorySection)
    assert history is not None
    assert history.path == Path("/var/lib/plc/history.db")
    assert config.state_file == Path("/var/lib/plc/state.json")
    assert config.secret_file == tmp_path / "secret.txt"


def test_absolute_paths_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/plc")
    own = {"gateway": {"state": "/srv/s.json"}, "history": {"path": "/srv/h.db"}}
    config = load(write_config(tmp_path / "c.yaml", ENDPOINT, LINES, **own))
    history = config.part(HistorySection)
    assert history is not None
    assert (history.path, config.state_file) == (Path("/srv/h.db"), Path("/srv/s.json"))


def test_the_history_is_not_the_state_file_that_nobody_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    file = write_config(tmp_path / "c.yaml", ENDPOINT, LINES, history={"path": "state.json"})
    with pytest.raises(ConfigErrors, match="two files are needed"):
        load(file)
