"""Files of the gateway: it takes none of them for its history, and others cannot hold its lock."""

import json
import stat
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.processes import plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

SETTINGS: dict[str, dict[str, Any]] = {
    "history.path: c.yaml is the configuration file": {"history": {"path": "./c.yaml"}},
    "history.path: users.txt is zenoh.users_file": {"history": {"path": "users.txt"}},
    "history.path: link is zenoh.users_file": {"history": {"path": "link"}},
    "history.path: users is zenoh.users_file": {"history": {"path": "users"}},
    "gateway.state: users.txt is zenoh.users_file": {"gateway": {"state": "users.txt"}},
    "gateway.state: history.db.lock is a file of history.path": {
        "gateway": {"state": "history.db.lock"},
        "history": {},
    },
    "gateway.audit: s.json is a file of gateway.state": {
        "gateway": {"state": "s.json", "audit": "s.json"},
    },
}


@pytest.mark.parametrize("sentence", SETTINGS)
def test_no_file_of_the_gateway_is_taken_for_another(tmp_path: Path, sentence: str) -> None:
    users = tmp_path / "users.txt"
    users.write_text("viewer:secret\n")
    users.chmod(0o600)
    (tmp_path / "link").symlink_to(users)
    (tmp_path / "users").hardlink_to(users)
    file = write_config(
        tmp_path / "c.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", {"speed": {"address": "D1"}})},
        **SETTINGS[sentence],
    )
    document = json.loads(file.read_text())
    document["zenoh"]["users_file"] = "users.txt"
    file.write_text(json.dumps(document))
    before = sorted(tmp_path.iterdir())
    done = plc_gateway("run", file)
    assert done.code == 2
    assert sentence in done.err
    assert users.read_text() == "viewer:secret\n"
    assert sorted(tmp_path.iterdir()) == before


def test_other_users_cannot_read_the_history_or_hold_its_lock(tmp_path: Path) -> None:
    (tmp_path / "history.db.lock").touch(0o666)  # an older gateway left it open to everybody
    (tmp_path / "history.db.lock").chmod(0o644)
    file = write_config(
        tmp_path / "c.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", {"speed": {"address": "D1", "history": True}})},
        history={},
    )
    with started(file) as gateway:
        gateway.says("history ready")
        files = list(tmp_path.glob("history.db*"))
        assert len(files) >= 3
        for each in files:
            assert not stat.S_IMODE(each.stat().st_mode) & stat.S_IRWXO, each
