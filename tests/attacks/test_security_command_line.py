"""docs/security.md, the command line at a secured gateway: each rule, with its attacker."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from gateway.cli.client import connected
from gateway.cli.client.connection import PASSWORD_VARIABLE, USER_VARIABLE
from gateway.cli.main import cli
from gateway.config import load
from gateway.errors import ConfigError
from tests.attacks.security_pages import VALUES, block, plant_file, quoted, serving
from tests.e2e.processes import ROOT, Done
from tests.northbound.access import GATEWAY_RULES, PASSWORDS, certificates, secret, users

SECTION = "Use the command line with a secured gateway"


def test_the_commands_of_the_page_write_with_the_files_that_the_person_may_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a command may not read holds nothing that it could use."""
    quoted("read access to the configuration file, `ca` and `config_file`;")
    quoted("They read neither `users_file` nor `writers.file`.")
    quoted("without the variables also to `password_file`")
    gateway, person = tmp_path / "gateway", tmp_path / "person"
    gateway.mkdir()
    certificates(gateway)("gateway")
    users(gateway)
    secret(gateway / "writers.txt", f"alice:{'s' * 40}\n")
    secret(gateway / "password.txt", PASSWORDS["viewer"])
    (gateway / "access.json5").write_text(GATEWAY_RULES)
    page = block("Restrict connections", "yaml", 1)
    kept = [line for line in page.splitlines() if "connect:" not in line]
    text = "\n".join(kept).replace("user: gateway", "user: viewer")
    path = plant_file(gateway, f"{text}\n  config_file: access.json5\n")
    readable = {"plant.yaml", "ca.pem", "access.json5"}
    with serving(path):
        shutil.copytree(gateway, person)
        for file in person.iterdir():
            if file.name not in readable:
                file.write_text("")
        typed = as_typed(person, block(SECTION, "console"), PASSWORDS["operator"])
        assert (typed.code, "acknowledged" in typed.out) == (0, True), typed
        for needed, user in (
            ("ca.pem", "operator"),
            ("access.json5", "operator"),
            ("password.txt", None),
        ):
            folder = shutil.copytree(person, tmp_path / f"without-{needed}")
            (folder / needed).write_text("")
            with pytest.raises(ConfigError, match=needed):
                values_for(user, folder / "plant.yaml", monkeypatch)
        # Without the variables: the user and the password of the file.
        shutil.copy(gateway / "password.txt", person)
        assert values_for(None, person / "plant.yaml", monkeypatch) == VALUES


def values_for(user: str | None, path: Path, variables: pytest.MonkeyPatch) -> int:
    """Returns the number of values that the command line gets as this user."""
    with variables.context() as own:
        if user is not None:
            own.setenv(USER_VARIABLE, user)
            own.setenv(PASSWORD_VARIABLE, PASSWORDS[user])
        with connected(load(path), print) as client:
            return len(client.values("**"))


def as_typed(folder: Path, console: str, password: str) -> Done:
    """Types the commands of a page into a shell, and the password where it asks for it."""
    program = folder / "plc-gateway"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m gateway "$@"\n')
    program.chmod(0o755)
    script = [line.removeprefix("$ ") for line in console.splitlines()]
    done = subprocess.run(
        ["bash", "-c", "\n".join(["PATH=$PWD:$PATH", *script])],
        input=password + "\n",
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    program.unlink()
    return Done(done.returncode, done.stdout, done.stderr)


def test_no_option_takes_a_secret() -> None:
    """The list of processes and the shell's history would show it."""
    quoted("They are not options, because the list of processes and the shell's history")
    group: Any = typer.main.get_command(cli)
    assert len(group.commands) > 15
    for command in group.commands.values():
        names = [option.name for option in command.params]
        assert not any("password" in name or "user" in name or "secret" in name for name in names)
