"""Fixtures shared by all tests."""

import gc
import os
import shutil
import sys
from collections.abc import Callable, Coroutine, Generator, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import pytest
import structlog
from hypothesis import settings

from tests.e2e import processes
from tests.e2e.processes import Done
from tests.sim.virtual import run_virtual as run_virtual_coroutine

settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
processes.forks = True
Command = Callable[..., Done]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keeps the tests, half a million objects, out of each collection of garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.fixture(autouse=True)
def _logs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Takes back what a command that ran in this process set up, and lets no logger keep it."""
    before, configure = structlog.get_config(), structlog.configure

    def uncached(**changed: Any) -> None:
        configure(**changed | {"cache_logger_on_first_use": False})

    monkeypatch.setattr(structlog, "configure", uncached)
    yield
    configure(**before)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """`plc-gateway` in this process, for commands that start nothing and open no serial port: half
    a second less each than in a process of its own. `env`: variables besides those of the test."""
    from gateway.cli.main import main  # most tests need none

    def run(*arguments: object, env: Mapping[str, str] = MappingProxyType({})) -> Done:
        before, _ = capsys.readouterr()
        with monkeypatch.context() as patched:
            patched.setattr(sys, "argv", ["plc-gateway", *map(str, arguments)])
            for name, value in env.items():
                patched.setenv(name, value)
            try:
                main()
                code: Any = 0
            except SystemExit as end:
                code = end.code or 0
        done = Done(code, *capsys.readouterr())
        print(before, end="")  # of programs that ended, for a test that fails
        return done

    return run


@pytest.fixture
def run_virtual() -> Callable[[Coroutine[Any, Any, Any]], Any]:
    """Runs a coroutine to its end on a virtual clock: hours in seconds, the same every time."""
    return run_virtual_coroutine


def needs(program: str) -> str:
    """Returns the path of a program that a test needs (see `lacking`)."""
    own = Path(sys.executable).parent  # programs that pip installs
    places = f"{own}:{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin"
    return shutil.which(program, path=places) or lacking(f"{program} is not installed")


def forbidden(what: str) -> NoReturn:
    """Skips a test of what this machine does not let us do, which nobody can install."""
    pytest.skip(what)


def lacking(what: str) -> NoReturn:
    """Skips the test and says why; where PLC_GATEWAY_NO_SKIPS=1 is set, the test fails instead."""
    if os.environ.get("PLC_GATEWAY_NO_SKIPS") == "1":
        pytest.fail(f"{what}, and PLC_GATEWAY_NO_SKIPS=1 lets nothing be skipped")
    pytest.skip(what)
