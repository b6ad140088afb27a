"""The `scan` command."""

from pathlib import Path

import pytest

from tests.conftest import Command
from tests.e2e.processes import free_port, plc_gateway, station


def test_scan_prints_a_configuration_of_the_stations_found(tmp_path: Path) -> None:
    number = free_port()
    with station("tcp", str(number), stations=(2, 5)):
        port = f"tcp://127.0.0.1:{number}"
        done = plc_gateway("scan", "--port", port, "--protocol", "vigor", "--stations", "1-5")
        assert done.code == 0
        assert done.err == "asking 5 stations at the port\n"
        path = tmp_path / "found.yaml"
        path.write_text(done.out)
        checked = plc_gateway("check", path)
        assert checked.out.endswith("found.yaml: good, 0 tags on 1 line\n"), checked
        nobody = plc_gateway("scan", "--port", port, "--protocol", "vigor", "--stations", "7")
        assert (nobody.code, nobody.out) == (1, "")
        assert nobody.err.endswith(f"no station replied at {port}\n")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--protocol", "vigor"], "--port"),
        (
            ["--port", "COM3", "--protocol", "frames"],
            "scan cannot look for frames: use one of vigor",
        ),
        (["--port", "COM3", "--protocol", "vigor", "--baud", "fast"], "'fast' is no number"),
    ],
)
def test_scan_names_a_wrong_option(command: Command, options: list[str], says: str) -> None:
    done = command("scan", *options)
    assert done.code == 2
    assert says in done.err
