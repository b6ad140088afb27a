"""The examples of docs/modbus.md are files the gateway takes."""

import re
from pathlib import Path

import pytest

from gateway.config import load

PAGE = (Path(__file__).parents[2] / "docs" / "modbus.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)


def test_there_is_an_example_for_every_dialect() -> None:
    for dialect in ("vigor", "k120s", "ex485lnk"):
        assert any(f"addressing: {dialect}" in example for example in EXAMPLES)


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_example_is_accepted(example: str, tmp_path: Path) -> None:
    file = tmp_path / "example.yaml"
    file.write_text(f"gateway: {{name: docs}}\n{example}", encoding="utf-8")
    devices = [device for line in load(file).lines for device in line.devices]
    assert devices
    assert all(device.tags for device in devices)
