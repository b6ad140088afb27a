"""One process of a gateway runs with one state folder."""

import socket
import stat
from pathlib import Path

import pytest

from gateway.errors import GatewayError
from gateway.northbound.session.one_process import only_process

OWN = "plant/@gateway/demo"


def test_a_second_process_of_a_gateway_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    second = pytest.raises(GatewayError, match="runs already on this machine")
    with only_process(tmp_path, OWN, "[]", "[]"):
        with second, only_process(tmp_path, OWN, "[]", "[]"):
            pass
        elsewhere = only_process(tmp_path, OWN, "[]", '["tcp/10.0.0.1:7447"]')
        with elsewhere, only_process(tmp_path, f"{OWN}-2", "[]", "[]"):
            pass
    with only_process(tmp_path, OWN, "[]", "[]"):
        pass


def test_only_the_owner_can_open_the_lock_file(tmp_path: Path) -> None:
    with only_process(tmp_path, OWN):
        [file] = tmp_path.iterdir()
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_without_a_folder_for_it_the_gateway_runs(tmp_path: Path) -> None:
    for folder in (None, tmp_path / "missing"):
        with only_process(folder, OWN), only_process(folder, OWN):
            pass


def test_a_file_of_another_kind_at_its_place_keeps_no_gateway_out(tmp_path: Path) -> None:
    with only_process(tmp_path, OWN):
        [file] = tmp_path.iterdir()
    file.unlink()
    with socket.socket(socket.AF_UNIX) as held:
        held.bind(str(file))
        with only_process(tmp_path, OWN):
            pass
