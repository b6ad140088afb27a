"""`check` refuses what `run` refuses, with the same sentence."""

from pathlib import Path

import pytest

from tests.e2e.processes import gateway, plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

LINES = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}


@pytest.mark.parametrize("prefix", ["plant:1", "my plant"])
def test_a_prefix_that_is_no_key(tmp_path: Path, prefix: str) -> None:
    file = write_config(tmp_path / "config.yaml", free_endpoint(), LINES)
    file.write_text(file.read_text().replace('"prefix": "plant"', f'"prefix": "{prefix}"'))
    assert prefix in file.read_text()
    checked = plc_gateway("check", file)
    assert checked.code == 2
    assert "zenoh.prefix" in checked.err
    with gateway("run", file) as running:
        assert running.ended() == 2
        assert running.has_said(checked.err.strip().splitlines()[0])


def test_a_name_with_a_vowel_mark_is_served(tmp_path: Path) -> None:
    name = "\u0915\u093f"
    file = write_config(tmp_path / "config.yaml", free_endpoint(), LINES, gateway={"name": name})
    assert plc_gateway("check", file).code == 0
    with started(file) as running:
        assert running.end() == 0
