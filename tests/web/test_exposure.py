"""The file without `web` costs nothing, and `check` knows what other machines can reach."""

import subprocess
import sys
from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.errors import ConfigError
from gateway.parts.web import exposure
from tests.e2e.processes import ROOT, vigor_line, write_config
from tests.web.serving import TOKEN

LINES = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}


def warned(folder: Path, token: str = TOKEN, **web: object) -> list[str]:
    tokens = folder / "tokens.txt"
    tokens.write_text(f"alice:{token}\n")
    tokens.chmod(0o600)
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", LINES, web=web)
    return exposure.check(load(path))


def test_the_web_server_is_imported_only_where_the_file_has_web() -> None:
    program = (
        "import sys, gateway.cli.main, gateway.service.service, gateway.parts.web.exposure; "
        "print([name for name in ('aiohttp', 'prometheus_client') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_an_address_for_other_machines_is_warned_of(tmp_path: Path) -> None:
    assert warned(tmp_path, listen="127.0.0.1:8080") == []
    assert warned(tmp_path, listen="[::1]:8080", tokens_file="tokens.txt") == []
    [warning] = warned(tmp_path, listen="0.0.0.0:8080", tokens_file="tokens.txt")
    assert "not encrypted" in warning


def test_an_address_for_other_machines_without_tokens_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="name a tokens_file too"):
        warned(tmp_path, listen="0.0.0.0:8080")


def test_a_short_token_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="20 to 200 characters"):
        warned(tmp_path, "short", listen="127.0.0.1:8080", tokens_file="tokens.txt")


def test_an_overview_of_an_unknown_tag_is_refused(tmp_path: Path) -> None:
    assert warned(tmp_path, overview=["mixer/speed", "mixer/*"]) == []
    with pytest.raises(ConfigErrors, match="there is no tag oven/\\*"):
        warned(tmp_path, overview=["mixer/speed", "oven/*"])
