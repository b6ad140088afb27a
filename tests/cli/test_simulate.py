"""The `simulate` command."""

import signal
from pathlib import Path

import pytest

from tests.e2e.processes import gateway, plc_gateway


@pytest.mark.parametrize(
    ("option", "value", "code", "says"),
    [
        ("--tcp", "4001", 2, "--tcp 4001: write it as 127.0.0.1:4001"),
        ("--tcp", "127.0.0.1:99999", 2, "write it as 127.0.0.1:4001"),
        ("--links", "/no/such/folder", 2, "--links /no/such/folder: there is no such folder"),
    ],
)
def test_simulate_refuses_a_bad_address_or_folder(
    config: Path, option: str, value: str, code: int, says: str
) -> None:
    done = plc_gateway("simulate", config, option, value)
    assert (done.code, done.out) == (code, "")
    assert says in done.err


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGINT])
def test_simulate_prints_its_ports_and_removes_links_at_the_end(
    config: Path, tmp_path: Path, by: signal.Signals
) -> None:
    with gateway("simulate", config, "--links", tmp_path) as simulated:
        simulated.says(f"line hall: stations 1 at {tmp_path / 'hall'}")
        simulated.says("Ctrl-C ends it.")
        assert simulated.end(by) == 0
    assert not (tmp_path / "hall").is_symlink()
