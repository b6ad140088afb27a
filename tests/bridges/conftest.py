"""The peers of the bridges. A missing peer skips the test, or fails it (see `tests.conftest`)."""

import sys
from typing import Protocol

import pytest

from tests.conftest import lacking, needs
from tests.e2e.processes import ROOT, Program

INTEROP = ROOT / "tests" / "interop"


def bridge(name: str, *options: object) -> Program:
    """Starts `plc-gateway bridge NAME`."""
    return Program(sys.executable, "-m", "gateway", "bridge", name, *options)


class Broker(Protocol):
    def __call__(self, port: int) -> Program: ...


@pytest.fixture
def mosquitto() -> Broker:
    """Starts a broker that keeps nothing when it ends."""
    program = needs("mosquitto")
    needs("mosquitto_sub")

    def start(port: int) -> Program:
        broker = Program(program, "-v", "-p", port)
        broker.says("version", "running")
        return broker

    return start


@pytest.fixture
def influxd() -> str:
    return needs("influxd")


@pytest.fixture(scope="module")
def node() -> str:
    """Runs npm's OPC UA client."""
    program = needs("node")
    if not (INTEROP / "node_modules" / "node-opcua-client").is_dir():
        lacking("npm's node-opcua-client is not installed (npm ci in tests/interop)")
    return program
