"""The peers of these tests. A missing peer skips the test, or fails it (see `tests.conftest`)."""

import subprocess
from pathlib import Path

import pytest

from tests.conftest import lacking, needs
from tests.interop.peers import HERE


@pytest.fixture
def socat() -> str:
    return needs("socat")


@pytest.fixture
def modbus_serial() -> str:
    """The program that runs npm's modbus-serial."""
    node = needs("node")
    if not (HERE / "node_modules" / "modbus-serial").is_dir():
        lacking("npm's modbus-serial is not installed (npm ci in tests/interop)")
    return node


@pytest.fixture(scope="session")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with modbus_slave and modbus_master, built."""
    folder = tmp_path_factory.mktemp("libmodbus")
    compiler, finder = needs("gcc"), needs("pkg-config")
    flags = subprocess.run(
        [finder, "--cflags", "--libs", "libmodbus"], check=False, capture_output=True, text=True
    )
    if flags.returncode:
        lacking("libmodbus-dev is not installed")
    for name in ("modbus_slave", "modbus_master"):
        source = HERE / f"{name}.c"
        command = [compiler, "-O2", "-Wall", "-o", str(folder / name), str(source)]
        subprocess.run([*command, *flags.stdout.split()], check=True)
    return folder
