"""Fixtures shared by all tests."""

import os
import shutil
import sys
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
import structlog
from hypothesis import settings

from tests.sim.virtual import run_virtual as run_virtual_coroutine

settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")


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
