"""The end of a bridge."""

import asyncio
import os
import signal
import sys

import pytest

from gateway.bridges import program
from gateway.errors import ConfigError
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import PATIENCE, Program
from tests.zenoh_peer import free_endpoint


def test_a_bridge_whose_library_loses_a_cancellation_ends_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(program, "CANCEL_EVERY", 0.01)
    cancelled = 0

    async def part() -> None:
        nonlocal cancelled
        os.kill(os.getpid(), signal.SIGTERM)
        while True:
            try:
                await asyncio.sleep(300)
            except asyncio.CancelledError:
                cancelled += 1
                if cancelled > 1:
                    raise

    async def bridge() -> None:
        async with asyncio.TaskGroup() as group:  # cancels its tasks once
            group.create_task(part())

    program.run(bridge())
    assert cancelled == 2


HUNG = """
import asyncio, ctypes, signal, time
from gateway import ending
from gateway.bridges import program

async def close(sleep):
    try:
        await asyncio.sleep(300)
    finally:
        sleep(300)

async def bridge():
    print("ready", flush=True)
    await (HOW)

ending.WITHIN = 0.5
program.run(bridge())
"""


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("asyncio.to_thread(time.sleep, 300)", "not ended 0.5 s after the signal: "),
        ("asyncio.sleep(time.sleep(300))", "not ended 0.5 s after the signal: "),
        ("close(time.sleep)", "not ended 0.5 s after the signal: "),
        ("close(ctypes.PyDLL(None).sleep)", "Timeout (0:00:0"),
    ],
    ids=["thread", "loop", "close", "close with Python's lock"],
)
def test_a_bridge_ends_whatever_stands_still(how: str, said: str, by: signal.Signals) -> None:
    with Program(sys.executable, "-c", HUNG.replace("HOW", how)) as bridge:
        bridge.says("ready")
        assert bridge.end(by) == 1
        assert bridge.has_said(said)
        assert bridge.has_said("most recent call first")


WAITS = """
import asyncio, time
from gateway import ending

async def command():
    stop = ending.stop_event()
    print("ready", flush=True)
    await stop.wait()
    await asyncio.to_thread(time.sleep, 300)

ending.WITHIN = 0.5
asyncio.run(command())
"""


def test_a_command_ends_whatever_stands_still() -> None:
    """`simulate`, `replay --serve`, `bench` and `ca serve` end by this event."""
    with Program(sys.executable, "-c", WAITS) as command:
        command.says("ready")
        assert command.end(signal.SIGTERM) == 1
        assert command.has_said("not ended 0.5 s after the signal: ")


async def test_a_bridge_whose_first_router_is_dead_uses_the_next_one() -> None:
    dead, alive = free_endpoint(), free_endpoint()
    with PlayedGateway(alive, {}):
        async with asyncio.timeout(PATIENCE):
            session = await program.opened(program.Gateways([dead, alive], None, "plant"))
        session.close()  # type: ignore[no-untyped-call]  # the stub lacks it


def test_a_bridge_without_its_packages_names_them() -> None:
    named = pytest.raises(ConfigError, match="pip install aiomqtt protobuf")
    with named, program.packages_of("bridge mqtt"):
        raise ModuleNotFoundError("no", name="aiomqtt")
    with pytest.raises(ModuleNotFoundError), program.packages_of("bridge mqtt"):
        raise ModuleNotFoundError("no", name="gateway.bridges.none")


def test_a_name_of_another_program_forges_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    program.say("plant/@gateway/a\nplant/@gateway/b\x1b[2J: archived")
    assert capsys.readouterr().err == "plant/@gateway/a\ufffdplant/@gateway/b\ufffd[2J: archived\n"
