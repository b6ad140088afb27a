"""Every command of the pages: it runs here, in a test that is named, or not at all for a reason."""

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from gateway.cli.main import main
from tests.e2e.processes import PATIENCE, ROOT, gateway, plc_gateway, started, until, until_exit
from tests.test_docs import EXAMPLE, TEXT, _blocks
from tests.zenoh_peer import free_endpoint, free_port

TUTORIALS = ("tutorial-vigor.md", "tutorial-computer-link.md", "tutorial-modbus.md")


class Typed(NamedTuple):
    """A command of a page, in one line."""

    page: str
    words: str


def typed(page: str) -> Iterator[Typed]:
    for block in _blocks(page):
        if block.language == "console":
            text = re.sub(r" *\\\n\s*", " ", block.text)
            for line in re.findall(r"^(?:\$|#) (.*)$", text, re.MULTILINE):
                yield Typed(page.lstrip("/"), re.sub(r" {2,}# .*", "", line))


ALL = [one for page in TEXT for one in typed(page)]

# Pages whose commands a test goes through, one after another.
PAGES = {
    "first-plant.md": "tests/e2e/test_first_plant.py",
    "sheet-to-scada.md": "tests/e2e/test_sheet_to_scada.py",
    **dict.fromkeys(TUTORIALS, "tests/e2e/test_page_commands.py"),
}
# Other commands, and the test that runs them, with other names of files.
TESTS = {
    r"\.venv/bin/plc-gateway (watch|read) config": "tests/e2e/test_newcomer.py",
    r"\.venv/bin/plc-gateway write config": "tests/test_docs.py",
    r"plc-gateway archive (run|status) ": "tests/archive/test_archive.py",
    r"plc-gateway bench ": "tests/cli/test_bench.py",
    r"plc-gateway bridge mqtt .*--sparkplug": "tests/bridges/test_sparkplug.py",
    r"plc-gateway bridge mqtt|mosquitto_(sub|pub) ": "tests/bridges/test_mqtt.py",
    r"plc-gateway bridge influx|curl -G 'http://127.0.0.1:8086": "tests/bridges/test_influx.py",
    r"plc-gateway bridge opcua ": "tests/bridges/test_opcua.py",
    r"plc-gateway control config.yaml press": "tests/e2e/test_computer_link.py",
    r"(runuser .*)?plc-gateway ca (create|issue)": "tests/cli/test_certificates.py",
    r"plc-gateway ca |.*plc-gateway enrol ": "tests/cli/test_enrolment.py",
    r"plc-gateway trace |plc-gateway replay ": "tests/e2e/test_trace.py",
    r".*pytest tests/cases/test_wire_logs.py": "tests/cases/test_wire_logs.py",
    r".*plc-gateway history (salvage|known)": "tests/cli/test_history.py",
    r"plc-gateway line ": "tests/doors/test_doors.py",
    r"plc-gateway import boiler.json": "tests/cli/test_import_foreign.py",
    r"plc-gateway import table.csv": "tests/cli/test_import_transfers.py",
    r"plc-gateway peek .*(--port|--watch)": "tests/e2e/test_peek.py",
    r"plc-gateway scan --port /dev/ttyUSB0": "tests/cli/test_scan_command.py",
    r"export PLC_|read -rs PLC_|plc-gateway write plant.yaml mixer/recipe 7": (
        "tests/attacks/test_security_command_line.py"
    ),
    r"(python3|ros2) .*(ros2|/plant)": "tests/bridges/test_ros2.py",
    r'curl -H "Authorization': "tests/web/test_guard.py",
    r"mbpoll ": "tests/interop/test_doors.py",
}
# Why no test runs them.
NOT_RUN = {
    r"(cc|\./read_and_write) ": "zenoh-pico is not at hand; docs/languages.md tells",
    r"make ": "it runs this suite, or for minutes to hours",
    r".*\bpip install": "it needs the network; tests/test_installs.py tries what it can",
    r"sudo -u postgres ": "it changes the machine; tests/archive has a server of its own",
    r"docker ": "it needs Docker; tests/test_packaging.py reads the Dockerfile",
    r"systemctl |systemd-sysusers |runuser .* check|kill -HUP \$\(pidof": (
        "it changes the services of the machine; tests/test_packaging.py reads the units"
    ),
    r"(ln|cp|install) .*(/opt|/etc|/var|history\.db)|rm -f history\.db": "it changes the machine",
    r"cat /etc/": "the file is that of a person",
    r"(sha256sum|gh|tar|cd) ": "it needs a published release; tests/test_release.py makes one",
    r"python3 -m venv /opt": "it changes the machine; .ci/smoke does the same elsewhere",
}
# Those that run here with the example gateway, its history and its page.
HERE = (
    r"plc-gateway write config.example.yaml mixer/steps",
    r"plc-gateway write config.yaml mixer recipe=8",
    r"plc-gateway import tags.csv",
    r"plc-gateway export ",
    r"plc-gateway (status|check|audit) plant.yaml",
    r"plc-gateway peek plant.yaml mixer \S+$",
    r"(/opt/\S*/)?plc-gateway (backup|check|doctor) ",
    r"plc-gateway history export ",
    r"sqlite3 ",
    r"curl -g ",
    r"python3 -c |chmod ",
)


def kinds(one: Typed) -> list[str]:
    """Returns the tables that have it."""
    if one.page in PAGES:
        return ["a page"]
    tables = {"here": HERE, "tests": TESTS, "not run": NOT_RUN}
    return [name for name, of in tables.items() if any(re.match(how, one.words) for how in of)]


def test_every_command_of_the_pages_is_run_or_has_its_reason() -> None:
    assert [(one, kinds(one)) for one in ALL if len(kinds(one)) != 1] == []
    used = {how for how in (*HERE, *TESTS, *NOT_RUN) if any(re.match(how, o.words) for o in ALL)}
    assert {*HERE, *TESTS, *NOT_RUN} - used == set()
    assert [test for test in (*PAGES.values(), *TESTS.values()) if not (ROOT / test).exists()] == []
    assert len([one for one in ALL if kinds(one) != ["not run"]]) > 100
    # The test that is named has the command.
    for one in ALL:
        if kinds(one) == ["tests"] and "plc-gateway " in one.words:
            test = next(test for how, test in TESTS.items() if re.match(how, one.words))
            verb = one.words.partition("plc-gateway ")[2].split()[0]
            assert verb in (ROOT / test).read_text("utf-8"), (one, test)


@pytest.fixture(name="shell")
def _shell(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[[str], str]:
    """Runs a command in a folder of its own, and returns what it printed; plc-gateway alone runs in
    this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("COLUMNS", "120")

    def run(words: str) -> str:
        if not words.startswith("plc-gateway ") or ">" in words:
            done = subprocess.run(
                ["bash", "-c", words], capture_output=True, text=True, timeout=PATIENCE, check=False
            )
            assert done.returncode == 0, (words, done)
            return done.stdout
        monkeypatch.setattr(sys, "argv", shlex.split(words))
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        assert code == 0, (words, out, err)
        return out

    return run


def test_the_commands_of_an_operator_work(shell: Callable[[str], str], tmp_path: Path) -> None:
    page = f"127.0.0.1:{free_port()}"
    text = EXAMPLE.read_text().replace("tcp/127.0.0.1:7447", free_endpoint())
    text = text.replace("127.0.0.1:8080", page)
    text = text.replace("name: demo ", "audit: audit.jsonl\n  name: demo ")
    text = text.replace("# history: {", "history: {")
    text = text.replace("every: 500ms,", "every: 500ms, history: true,", 1)
    for name in ("plant.yaml", "config.yaml", "config.example.yaml", "hall.yaml"):
        (tmp_path / name).write_text(text)
    (tmp_path / "tags.csv").write_text("Name,Address\nof-the-page,D700\n")
    with started(tmp_path / "plant.yaml") as program:
        for _ in range(3):
            program.says("device online")
        until(lambda: "mixer/speed" in shell("plc-gateway history export plant.yaml"), "history")
        for one in ALL:
            if kinds(one) == ["here"]:
                words = one.words.replace("127.0.0.1:8080", page)
                words = re.sub(r"/opt/\S*/plc-gateway", "plc-gateway", words)
                words = words.replace("/etc/plc-gateway/", "").replace("/backup/", "")
                (tmp_path / "tags.csv").unlink() if "--output tags.csv" in words else None
                print(words, shell(words))
        assert program.end(signal.SIGINT) == 0


@pytest.mark.parametrize("page", TUTORIALS)
def test_every_command_of_a_tutorial_works(
    page: str, shell: Callable[[str], str], tmp_path: Path
) -> None:
    """At a simulated PLC behind TCP instead of /dev/ttyUSB0."""
    [file] = [block.text for block in _blocks(page) if block.language == "yaml"]
    port, file_of = f"tcp://127.0.0.1:{free_port()}", tmp_path / "plant.yaml"
    simulated = tmp_path / "simulated.yaml"
    simulated.write_text(file)
    address = port.removeprefix("tcp://")
    with ExitStack() as stack:
        plc = stack.enter_context(gateway("simulate", simulated, "--tcp", address))
        plc.says(address)
        steps = [one.words.replace("/dev/ttyUSB0", port) for one in typed(page)]
        for words in steps:
            print(words)
            match words.split()[1]:
                case "scan":
                    assert "station:" in shell(words)
                case "new":
                    name = re.findall(r"^      (\w+):$", file, re.MULTILINE)[0]
                    shell(f"{words} --names {name}")
                    assert name in file_of.read_text()
                    made = file.replace("/dev/ttyUSB0", port)
                    file_of.write_text(f"zenoh: {{listen: [{free_endpoint()}]}}\n{made}")
                case "run":
                    stack.enter_context(started(file_of))
                    until_exit(0, plc_gateway, "read", file_of)
                case _:
                    print(shell(words))
