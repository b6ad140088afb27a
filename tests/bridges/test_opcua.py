"""`bridge opcua` with npm's OPC UA client: codes, times, writes, history."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.bridges.conftest import INTEROP, bridge
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import Program, free_port, started, until, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64", "unit": "rpm", "description": "of the drum"},
    "mixer/recipe": {"write": {"min": 1, "max": 40, "verify": False}},
    "mixer/alarms/door": {"type": "bool"},
    "mixer/name": {"type": "string[8]"},
    "mixer/steps": {"type": "uint16[3]", "length": 3, "write": {"verify": False}},
}


class Plant(NamedTuple):
    endpoint: str  # of Zenoh, where the gateway listens
    gateway: PlayedGateway
    client: Program

    def ask(self, command: str, *words: object) -> Any:
        """Executes a command of tests/interop/opcua_client.js."""
        return json.loads(self.client.tell(" ".join([command, *map(str, words)])))

    def status(self, key: str) -> str:
        return str(self.ask("read", node(key))["status"])


def node(key: str) -> str:
    return f"ns=2;s={key}"


@pytest.fixture(scope="module")
def plant(node: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    endpoint, url = free_endpoint(), f"opc.tcp://127.0.0.1:{free_port()}"
    folder = tmp_path_factory.mktemp("opcua")
    options = ("--connect", endpoint, "--listen", url, "--writes")
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        bridge("opcua", *options) as server,
        Program(node, INTEROP / "opcua_client.js", folder) as client,
    ):
        server.says("listening")
        client.tell(f"connect {url}")
        yield Plant(endpoint, gateway, client)
    assert "Traceback" not in "\n".join(server.lines)


def test_an_opc_ua_client_sees_no_good_value_and_no_write_that_is_not(plant: Plant) -> None:
    gateway = plant.gateway
    until(lambda: plant.status("mixer/name") == "BadWaitingForInitialData", "it has all tags")
    assert plant.ask("browse", "ns=2;s=/mixer/alarms/") == [node("mixer/alarms/door")]
    plant.ask("watch", node("mixer/speed"))

    gateway.put("mixer/speed", 12.5)
    plant.client.says("changed", "mixer/speed Good 12.5")
    for reason, code in {
        "no-reply": "BadDeviceFailure",
        "line-down": "BadNotConnected",
        "overdue": "BadResourceUnavailable",
        "new-reason": "Bad",
    }.items():
        gateway.put("mixer/speed", None, reason)
        plant.client.says("changed", f"mixer/speed {code} null")
    gateway.put("mixer/recipe", 70_000)  # more than its type
    gateway.put("mixer/name", "AB")
    until(lambda: plant.status("mixer/name") == "Good", "the name is read")
    assert plant.status("mixer/recipe") == "BadTypeMismatch"

    gateway.put("mixer/steps", [1, 2, 65535])
    until(lambda: plant.status("mixer/steps") == "Good", "the array is read")
    steps = plant.ask("read", node("mixer/steps"))
    assert (steps["value"], steps["type"]) == ([1, 2, 65535], "UInt16")

    # Nothing is written but by the gateway.
    write = ("write", node("mixer/recipe"), "Int16")
    assert plant.ask(*write, 7) == "Good"
    assert plant.ask("write", node("mixer/speed"), "Double", 1) == "BadNotWritable"
    assert plant.ask("write", node("mixer/recipe"), "Double", 1) == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/recipe"), "Int16", "[7]") == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/steps"), "UInt16", 7) == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/steps"), "UInt16", "[3,2,1]") == "Good"
    for outcome, code in {
        "refused": "BadInvalidState",
        "line-down": "BadNotConnected",
        "unclear": "BadTimeout",
        "silent": "BadTimeout",
        "new-outcome": "BadTimeout",
    }.items():
        gateway.answer = outcome
        assert plant.ask(*write, 8) == code
    assert [value for _, value in gateway.written] == [7, [3, 2, 1], 8, 8, 8, 8, 8]
    assert plant.status("mixer/recipe") == "BadTypeMismatch"

    # The client reads on while its write waits.
    gateway.answer = "held"
    gateway.put("mixer/speed", 13.5)
    plant.ask("start", *write[1:], 9)
    gateway.until_written(8)
    assert plant.ask("read", node("mixer/speed"))["value"] == 13.5
    gateway.close()
    assert plant.ask("written") == "BadTimeout"
    plant.client.says("changed", "mixer/speed BadNoCommunication null")
    assert plant.status("mixer/alarms/door") == "BadNoCommunication"


def test_an_opc_ua_client_reads_a_gateway_and_its_history(plant: Plant, tmp_path: Path) -> None:
    tags = {
        "speed": {"address": "D100", "scale": 0.1, "unit": "rpm", "every": "50ms", "history": True},
        "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
    }
    file = write_config(
        tmp_path / "c.yaml",
        plant.endpoint,
        {"hall": vigor_line("simulator", tags)},
        history={"path": "history.db"},
    )
    speed, recipe = node("mixer/speed"), node("mixer/recipe")
    plant.gateway.close()
    with started(file) as gateway:
        until(lambda: plant.status("mixer/recipe") == "GoodEdited", "a value is simulated")
        meta = plant.ask("meta", speed)
        assert (meta["type"], meta["access"], meta["unit"]) == ("Double", 5, "rpm")
        assert plant.ask("meta", recipe)["range"] == [1, 40]
        assert plant.ask("write", recipe, "Int16", 7) == "Good"
        assert plant.ask("write", recipe, "Int16", 41) == "BadOutOfRange"
        until(lambda: plant.ask("read", recipe)["value"] == 7, "the written value is read")
        assert gateway.says("tag written", "value=7")

        until(lambda: len(plant.ask("history", speed, 60, 0)["values"]) > 8, "there is history")
        whole = plant.ask("history", speed, 60, 3)["values"]
        back = plant.ask("history", speed, 60, 3, "back")["values"]
        assert whole[0]["status"] == "BadWaitingForInitialData"
        assert [known["status"] for known in whole[1:]] == ["GoodEdited"] * (len(whole) - 1)
        times = [known["time"] for known in whole]
        assert sorted(set(times)) == times
        assert back[::-1][: len(whole)] == whole
        last = plant.ask("history", speed, 0, 3, "last")["values"]
        assert last[::-1][: len(whole)] == whole
        assert plant.ask("history", recipe, 60, 0) == {"status": "BadHistoryOperationUnsupported"}

        gateway.end(signal.SIGKILL)
        until(lambda: plant.status("mixer/speed") == "BadNoCommunication", "it is bad")
        assert plant.ask("history", speed, 60, 0) == {"status": "BadNoCommunication"}
        assert plant.ask("write", recipe, "Int16", 8) == "BadNoCommunication"
