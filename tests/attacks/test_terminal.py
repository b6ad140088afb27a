"""Output that cannot be written, and texts that would control the terminal or forge log lines."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from tests.e2e.processes import PATIENCE, ROOT, plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def config(folder: Path, endpoint: str) -> Path:
    tags = {
        "température": {"address": "D10", "unit": "°C"},
        "name": {"address": "D600", "type": "string[16]", "write": True},
    }
    return write_config(folder / "c.yaml", endpoint, {"Öfen": vigor_line("simulator", tags)})


def printed_to(
    file: Path, *arguments: object, env: Mapping[str, str] = MappingProxyType({})
) -> "subprocess.CompletedProcess[str]":
    with file.open("w") as out:
        return subprocess.run(
            [sys.executable, "-m", "gateway", *map(str, arguments)],
            cwd=ROOT,
            stdout=out,
            stderr=subprocess.PIPE,
            env=os.environ | env,
            text=True,
            timeout=PATIENCE,
            check=False,
        )


@pytest.mark.parametrize("command", ["check", "schema", "--help"])
def test_a_full_disk_is_one_line_and_exit_code_1(command: str, tmp_path: Path) -> None:
    file = [config(tmp_path, free_endpoint())] if command == "check" else []
    ended = printed_to(Path("/dev/full"), command, *file)
    assert ended.stderr.splitlines() == ["the output cannot be written: No space left on device"]
    assert ended.returncode == 1


@pytest.mark.parametrize("command", [["check"], ["read", "--direct"]])
def test_a_locale_with_ascii_only_prints_names_escaped(command: list[str], tmp_path: Path) -> None:
    name, *options = command
    out = tmp_path / "out.txt"
    done = printed_to(out, name, config(tmp_path, free_endpoint()), *options, env=ASCII)
    assert done.returncode == 0, done.stderr
    assert "\\x" in out.read_text()


async def test_texts_of_the_network_control_neither_log_nor_terminal(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    file = config(tmp_path, endpoint)
    with started(file) as program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            forged = "\x1b[2J\n2026-11-20T12:00:00Z [info     ] tag written"
            await client.get("plant/mixer/name/@set", b'"A\\u001b[2J\\nB"')
            await client.get(f"plant/mixer/{forged}/@set", b"1")
            await client.get(f"plant/mixer/{forged}?max_age={forged}")
            program.says("unknown-tag")
            log = program.lines
            assert not any("\x1b" in line for line in log)
            assert not any(line.startswith("2026-11-20T12:00:00Z") for line in log)
        shown = plc_gateway("read", file, "mixer/name", "--max-age", "0s")
        assert "\x1b" not in shown.out
        assert "A\\x1b[2J\\nB" in shown.out
