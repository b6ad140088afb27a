"""The end of a bridge."""

import asyncio
import os
import signal

import pytest

from gateway.bridges import program
from gateway.errors import ConfigError


def test_a_bridge_whose_library_loses_a_cancellation_ends_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(program, "CANCEL_EVERY", 0.01)
    cancelled = 0

    async def bridge() -> None:
        nonlocal cancelled
        asyncio.get_running_loop().call_soon(os.kill, os.getpid(), signal.SIGTERM)
        while True:
            try:
                await asyncio.sleep(300)
            except asyncio.CancelledError:
                cancelled += 1
                if cancelled > 1:
                    raise

    program.run(bridge())
    assert cancelled == 2


def test_a_bridge_without_its_packages_names_them() -> None:
    named = pytest.raises(ConfigError, match="pip install aiomqtt protobuf")
    with named, program.packages_of("bridge mqtt"):
        raise ModuleNotFoundError("no", name="aiomqtt")
    with pytest.raises(ModuleNotFoundError), program.packages_of("bridge mqtt"):
        raise ModuleNotFoundError("no", name="gateway.bridges.none")


def test_a_name_of_another_program_forges_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    program.say("plant/@gateway/a\nplant/@gateway/b\x1b[2J: archived")
    assert capsys.readouterr().err == "plant/@gateway/a\ufffdplant/@gateway/b\ufffd[2J: archived\n"
