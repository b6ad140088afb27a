"""A part with settings, document, fault, route and command is a folder, and a line of the list."""

import json
import subprocess
import sys
import urllib.request
from pathlib import Path

from tests.e2e.processes import ROOT, Program, vigor_line, write_config
from tests.zenoh_peer import free_endpoint, free_port

# All that a new part changes outside of its folder: the list.
PROGRAM = """
from gateway.parts import registry
registry.PARTS = (*registry.PARTS[:-1], "tests.parts.toy", registry.PARTS[-1])
from gateway.cli.main import main
main()
"""
LINES = {"hall": vigor_line("simulator", {"level": {"address": "D10"}})}


def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_a_toy_part_has_settings_document_fault_route_and_command(tmp_path: Path) -> None:
    endpoint, port = free_endpoint(), free_port()
    web = {"listen": f"127.0.0.1:{port}"}
    file = write_config(tmp_path / "c.yaml", endpoint, LINES, web=web, toy={"greeting": "moin"})
    assert run("greet", file).stdout == "moin\n"
    with Program(sys.executable, "-c", PROGRAM, "run", file) as program:
        program.says("Zenoh session ready")
        status = run("health", file)
        assert status.returncode == 0, status.stderr
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/toy") as answer:
            assert json.load(answer) == {"greeting": "moin"}
        assert "the toy was greeted" in run("status", file).stdout
        documents = json.loads(run("status", file, "--json").stdout)
        assert documents["toy"] == {"greeting": "moin"}


def test_a_mistake_in_its_section_has_its_line(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    lines = json.dumps(LINES)
    file.write_text(f"lines: {lines}\ntoy:\n  greeting: ''\n")
    wrong = run("check", file)
    assert f"{file}:3: toy.greeting: an empty greeting greets nobody: write hello" in wrong.stderr
    file.write_text(f"lines: {lines}\ntoy:\n  greting: moin\n")
    assert "toy.greting: no setting of toy: did you mean greeting?" in run("check", file).stderr
    assert '"toy"' in run("schema").stdout


def test_without_its_line_in_the_list_there_is_no_such_section(tmp_path: Path) -> None:
    file = write_config(tmp_path / "c.yaml", free_endpoint(), LINES, toy={})
    command = [sys.executable, "-m", "gateway", "check", str(file)]
    wrong = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "toy: no setting of the file" in wrong.stderr
