"""The command line at a gateway that demands a user or a certificate."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest

from gateway.cli.client.connection import PASSWORD_VARIABLE, USER_VARIABLE
from tests.conftest import Command
from tests.e2e.processes import PATIENCE, Done, held, started, until_exit, vigor_line, write_config
from tests.northbound.access import (
    GATEWAY_RULES,
    PASSWORDS,
    ROUTER_RULES,
    certificates,
    secret,
    users,
)
from tests.zenoh_peer import free_endpoint

TAGS = {"speed": {"address": "D100"}, "recipe": {"address": "D500", "write": True}}


class Typed(Protocol):
    def __call__(self, user: str | None, *arguments: object, password: str = "") -> Done: ...


@pytest.fixture
def typed(command: Command) -> Typed:
    """`plc-gateway ...` as a user, or without one."""

    def run(user: str | None, *arguments: object, password: str = "") -> Done:
        done: Done = command(*arguments, env=known(user, password))
        return done

    return run


def known(user: str | None, password: str = "") -> dict[str, str]:
    """Returns the variables of a user."""
    if user is None:
        return {}
    return {USER_VARIABLE: user, PASSWORD_VARIABLE: password or PASSWORDS[user]}


def watched(user: str, path: Path) -> str:
    """Returns the first line of `watch` as a user."""
    command = f"{sys.executable} -m gateway watch {path} --json | head -n 1"
    env = {**os.environ, **known(user)}
    return subprocess.check_output(["sh", "-c", command], env=env, text=True, timeout=PATIENCE)


def plant_file(folder: Path, **zenoh_settings: Any) -> Path:
    lines = {"hall": vigor_line("simulator", TAGS)}
    settings = {"prefix": "plant", **zenoh_settings}
    return write_config(folder / "plant.yaml", "", lines, zenoh=settings)


def tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


@contextmanager
def closed_by_itself(folder: Path) -> Iterator[Path]:
    """As in docs/scada.md."""
    certificate, key = certificates(folder)("gateway")
    (folder / "access.json5").write_text(GATEWAY_RULES)
    path = plant_file(
        folder,
        listen=[tls_endpoint().replace("127.0.0.1", "0.0.0.0")],
        tls={"ca": "ca.pem", "certificate": certificate.name, "key": key.name},
        users_file=users(folder).name,
        config_file="access.json5",
    )
    with started(path) as program:
        program.says("device online")
        yield path


@contextmanager
def closed_by_a_router(folder: Path) -> Iterator[Path]:
    """A gateway in mode `router` stands for one: its rules are those of the page."""
    certificate, key = certificates(folder)("router")
    endpoint = tls_endpoint()
    tls = {"ca": "ca.pem", "certificate": certificate.name, "key": key.name}
    (folder / "access.json5").write_text(ROUTER_RULES)
    router = {
        "mode": "router",
        "prefix": "other",
        "listen": [endpoint],
        "tls": tls,
        "users_file": users(folder).name,
        "config_file": "access.json5",
    }
    lines = {"hall": vigor_line("simulator", {})}
    password = secret(folder / "password.txt", PASSWORDS["gateway"])
    path = plant_file(
        folder,
        listen=[],
        connect=[endpoint],
        tls={"ca": "ca.pem"},
        user="gateway",
        password_file=password.name,
    )
    with (
        started(write_config(folder / "router.yaml", "", lines, zenoh=router)),
        started(path) as it,
    ):
        it.says("device online")
        it.says("Zenoh link up")
        yield path


@pytest.mark.parametrize("closed", [closed_by_itself, closed_by_a_router])
def test_the_command_line_has_the_rights_of_its_user(
    typed: Typed, closed: Callable[[Path], AbstractContextManager[Path]], tmp_path: Path
) -> None:
    with closed(tmp_path) as path:
        until_exit(0, typed, "viewer", "read", path)
        assert json.loads(watched("viewer", path))["quality"] == "good"
        assert typed("operator", "write", path, "mixer/recipe", "7").code == 0
        done = typed("operator", "read", path, "mixer/recipe", "--json", "--max-age", "0s")
        assert (done.code, done.json["value"]) == (0, 7)
        done = typed("viewer", "write", path, "mixer/recipe", "8")
        assert (done.code, done.out) == (1, "")
        assert "nothing was sent; may viewer do this, and does the gateway run" in done.err
        # Enough for a container, and no more.
        assert typed("health", "health", path, "--json").json["name"] == "demo"
        done = typed("health", "read", path)
        assert (done.code, done.out) == (1, "")
        assert "no reply: " in done.err
        assert "may health query it?" in done.err
        done = typed("operator", "read", path, password="wrong")  # noqa: S106  (it is none)
        assert (done.code, done.out) == (1, "")
        assert "refuses the user operator: the name or password is wrong" in done.err
        assert len(done.err.splitlines()) == 1


def test_without_a_user_the_command_line_names_the_variables_to_set(
    typed: Typed, tmp_path: Path
) -> None:
    with closed_by_itself(tmp_path) as path:
        for name in ("read", "health"):
            done = typed(None, name, path)
            assert (done.code, done.out) == (1, "")
            assert "requires a name and password" in done.err
            assert f"set {USER_VARIABLE} and {PASSWORD_VARIABLE}" in done.err


def test_a_gateway_that_stands_still_is_called_that(command: Command, tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D1"}})}
    file = write_config(tmp_path / "c.yaml", free_endpoint(), lines)
    with started(file) as program:
        with held(program.pid):
            done = command("health", file)
        assert (done.code, done.out) == (1, "")
        assert "takes connections and does not answer: that process stands still" in done.err


def test_at_a_router_the_user_of_the_gateway_may_check_its_health_only(
    typed: Typed,
    tmp_path: Path,
) -> None:
    with closed_by_a_router(tmp_path) as path:
        done = until_exit(0, typed, None, "health", path, "--json")  # the router learns of it
        assert done.json["name"] == "demo"
        done = typed(None, "read", path)
        assert (done.code, done.out) == (1, "")
        assert "may gateway query it?" in done.err


def test_without_mutual_tls_the_command_line_does_not_read_the_private_key(
    typed: Typed, tmp_path: Path
) -> None:
    with closed_by_itself(tmp_path) as path:
        (tmp_path / "gateway.key").write_text("not for the command line")
        assert typed("operator", "health", path).code == 0


def test_a_certificate_for_another_address_is_named_as_the_reason(
    typed: Typed,
    tmp_path: Path,
) -> None:
    certificate, key = certificates(tmp_path)("gateway", "DNS:gateway.plant")
    own = {"ca": "ca.pem", "certificate": certificate.name, "key": key.name}
    endpoint = tls_endpoint()
    path = plant_file(tmp_path, listen=[endpoint.replace("127.0.0.1", "0.0.0.0")], tls=own)
    with started(path):
        done = typed(None, "read", path)
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith(f"{endpoint} has an untrusted certificate: ")
    assert "not valid for '127.0.0.1'" in done.err


@pytest.mark.parametrize("given", [USER_VARIABLE, PASSWORD_VARIABLE])
def test_a_user_without_a_password_is_a_mistake_and_so_is_the_reverse(
    typed: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    monkeypatch.setenv(given, "operator")
    done = typed(None, "read", plant_file(tmp_path, listen=[free_endpoint()]))
    assert (done.code, done.out) == (2, "")
    assert done.err == f"{USER_VARIABLE} and {PASSWORD_VARIABLE} belong together: set both\n"
