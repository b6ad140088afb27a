"""Peek through a running gateway: any addresses, while the gateway has the port."""

from pathlib import Path

from tests.e2e.processes import plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint


def test_addresses_that_no_tag_has_are_read_through_the_gateway(tmp_path: Path) -> None:
    line = vigor_line("simulator", {"run": {"address": "M5", "write": True}})
    path = write_config(tmp_path / "plant.yaml", free_endpoint(), {"hall": line})
    with started(path) as program:
        program.says("device online")
        assert plc_gateway("write", path, "mixer/run", "on").code == 0
        printed = plc_gateway("peek", path, "mixer", "M0..M7")
        assert printed.code == 0, printed.err
        assert printed.out.splitlines()[1].split()[:9] == ["M0", *"00000100"]
        refused = plc_gateway("peek", path, "mixer", "D0..D400")
        assert refused.code != 0
        assert "D0..D400 has more than 256 addresses" in refused.err
