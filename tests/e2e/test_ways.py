"""Every kind of port: a pty, a cable of two ptys, TCP, RFC 2217.

PLC, gateway and Zenoh client are processes of their own.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import needs
from tests.e2e.processes import (
    cable,
    device_server,
    free_port,
    gateway,
    started,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import Received, Subscription, ZenohPeer, free_endpoint

TAGS = {
    "speed": {"address": "D10", "scale": 0.1},
    "level": {"address": "D20", "type": "float32", "every": "500ms"},
    "door": {"address": "M12"},
    "button": {"address": "X17"},
    "batches": {"address": "C200"},
    "name": {"address": "D600", "type": "string[16]", "write": True},
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
    "run": {"address": "Y20", "write": True},
    "valve": {"address": "D7.3", "write": True},
}
OpenPort = Callable[[ExitStack, Path], str]


def _simulated_on_pty(stack: ExitStack, folder: Path) -> Path:
    """Simulates the same devices. Returns the link to their pty."""
    plan = write_config(
        folder / "plc.yaml", free_endpoint(), {"hall": vigor_line("/dev/ttyS1", TAGS)}
    )
    simulated = stack.enter_context(gateway("simulate", plan, "--links", folder))
    assert str(folder / "hall") in simulated.says("line hall: stations 1 at")
    simulated.says("Ctrl-C")
    return folder / "hall"


def _pty(stack: ExitStack, folder: Path) -> str:
    return str(_simulated_on_pty(stack, folder))


def _cable(stack: ExitStack, folder: Path) -> str:
    socat = needs("socat")
    far_end = f"file:{_simulated_on_pty(stack, folder)},raw,echo=0"
    stack.enter_context(cable(socat, folder / "near", far_end))
    return str(folder / "near")


def _tcp(stack: ExitStack, folder: Path) -> str:
    plan = write_config(
        folder / "plc.yaml", free_endpoint(), {"hall": vigor_line("/dev/ttyS1", TAGS)}
    )
    number = free_port()
    simulated = stack.enter_context(gateway("simulate", plan, "--tcp", f"127.0.0.1:{number}"))
    assert f"tcp://127.0.0.1:{number}" in simulated.says("line hall: stations 1 at")
    return f"tcp://127.0.0.1:{number}"


def _rfc2217(stack: ExitStack, folder: Path) -> str:
    program = needs("ser2net")
    number = free_port()
    stack.enter_context(device_server(program, folder, _simulated_on_pty(stack, folder), number))
    return f"rfc2217://127.0.0.1:{number}"


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize(
    "open_port", [_pty, _cable, _tcp, _rfc2217], ids=lambda open_port: open_port.__name__[1:]
)
async def test_values_arrive_and_writes_are_done(
    open_port: OpenPort, stack: ExitStack, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    port = open_port(stack, tmp_path)
    config = write_config(
        tmp_path / "config.yaml", endpoint, {"hall": vigor_line(port, TAGS, reply_timeout="2s")}
    )
    stack.enter_context(started(config))
    async with ZenohPeer("client", connect=[endpoint]) as client:
        samples = await client.subscribe("plant/**")
        for name in ("speed", "level", "batches"):
            await _wait_for_a_change(samples, f"plant/mixer/{name}")

        values = await client.get_all_until("plant/mixer/**", _are_good)
        assert set(values) == {f"plant/mixer/{name}" for name in TAGS}
        assert isinstance(values["plant/mixer/level"]["value"], float)
        assert isinstance(values["plant/mixer/door"]["value"], bool)
        assert values["plant/mixer/name"]["value"] == "SIMULATED"

        written = {"recipe": 7, "run": True, "valve": True, "name": "BATCH-7"}
        for name, value in written.items():
            [reply] = await client.get(f"plant/mixer/{name}/@set", json.dumps(value).encode())
            assert reply.ok, reply
            assert reply.json["value"] == value
            assert reply.json["verified"] is (name == "recipe")
            await samples.next(partial(_shows, name, value))
        [run] = await client.get("plant/mixer/run")
        assert run.json["value"] is True
        assert all(sample.encoding == "application/json" for sample in samples.samples)


def _shows(name: str, value: object, sample: Received) -> bool:
    return sample.key == f"plant/mixer/{name}" and bool(sample.json["value"] == value)


def _are_good(values: dict[str, Any]) -> bool:
    return {value["quality"] for value in values.values()} == {"good"}


async def _wait_for_a_change(samples: Subscription, key: str) -> None:
    """Waits for another good value: the first sample of a gateway that starts is null."""

    def is_good(sample: Received) -> bool:
        return sample.key == key and bool(sample.json["quality"] == "good")

    first = await samples.next(is_good)
    await samples.next(lambda s: is_good(s) and s.json["value"] != first.json["value"])
